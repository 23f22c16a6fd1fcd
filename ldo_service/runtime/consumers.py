"""Lossless consumers of a topic, as its producer tracks them."""

from collections.abc import Iterable
from dataclasses import dataclass

from ldo_service.transport.flow_control import Credit

from .actor import UNLIMITED


@dataclass
class Consumer:
    """State of one consumer; offsets are those of the next message."""

    alive: bool = False
    handled: int = 0  # Offset of the first message that it has not handled.
    arrived: int = 0  # Offset of the first message that it has not received.
    limit: int = 0  # Offset of the first message that exceeds its window.
    repeated_from: int = -1  # Offset at which the last retransmission began; -1: none.
    repeated_at_s: float = 0.0  # Time of the last retransmission.
    shut_since_s: float | None = None  # Time at which its window was first found full.


class Consumers:
    """Connected and required consumers of a topic, and the credit that they leave.

    Consumers in `expected` are required: they must not miss a message, so there is no credit while
    one of them is absent. Other consumers count only while they are alive. `seq` is always the
    offset of the next message.
    """

    def __init__(self, expected: Iterable[str], handled: int = 0) -> None:
        """Initialize with the required consumers.

        Args:
            expected: Names of the required consumers.
            handled: Offset before which each of them has handled every message.
        """
        self._known = {name: Consumer(handled=handled) for name in expected}
        self.expected = frozenset(self._known)
        self._evicted: dict[str, int] = {}  # Value of `handled` at the eviction, by consumer.

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, name: str) -> bool:
        return name in self._known

    def room(self, seq: int) -> int:
        """Return the number of messages that may be sent now to all consumers."""
        limits = [c.limit - seq if c.alive else 0 for c in self._known.values()]
        return max(0, min(limits, default=UNLIMITED))

    def handled(self, seq: int) -> int:
        """Return the offset before which all consumers have handled every message."""
        return min((c.handled for c in self._known.values()), default=seq)

    def all_received(self, seq: int) -> bool:
        """Return whether every consumer has received every message before `seq`."""
        return all(c.arrived >= seq for c in self._known.values())

    def next_seq_by_consumer(self) -> dict[str, int]:
        """Return the offset of the next message for each consumer, by name."""
        return {name: consumer.handled for name, consumer in self._known.items()}

    def join(self, name: str, seq: int) -> None:
        """Add a consumer that sent a hello; it receives all that it has not handled."""
        self._evicted.pop(name, None)
        consumer = self._known.setdefault(name, Consumer(handled=seq))
        consumer.alive, consumer.shut_since_s, consumer.repeated_from = True, None, -1
        consumer.arrived = consumer.limit = consumer.handled

    def grant(self, grant: Credit) -> Consumer:
        """Update a known consumer from its credit message."""
        self._evicted.pop(grant.consumer, None)
        consumer = self._known[grant.consumer]
        consumer.alive = True
        consumer.handled = max(consumer.handled, grant.handled)
        consumer.arrived = grant.arrived  # May decrease: a restarted consumer may have fewer.
        if grant.limit > consumer.limit or grant.waits_for_disk:
            consumer.limit, consumer.shut_since_s = max(grant.limit, consumer.limit), None
        return consumer

    def leave(self, name: str) -> None:
        """Mark a consumer as gone; only a required one still blocks the producer."""
        consumer = self._known[name]
        consumer.alive, consumer.shut_since_s = False, None
        if name not in self.expected:
            del self._known[name]

    def stalled(self, now_s: float, patience_s: float, seq: int) -> list[str]:
        """Return the live consumers with a window that was full for longer than `patience_s`."""
        names: list[str] = []
        for name, consumer in self._known.items():
            if consumer.alive and consumer.limit <= seq:
                if consumer.shut_since_s is None:
                    consumer.shut_since_s = now_s
                if now_s - consumer.shut_since_s > patience_s:
                    names.append(name)
        return names

    def evict(self, name: str) -> None:
        """Mark a stalled consumer as gone until it makes progress."""
        self._evicted[name] = self._known[name].handled
        self.leave(name)

    def is_still_stuck(self, grant: Credit) -> bool:
        """Return whether the consumer was evicted and has handled nothing since.

        Its heartbeats alone are no progress.
        """
        return grant.handled <= self._evicted.get(grant.consumer, -1)
