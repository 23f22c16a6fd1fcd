"""Lossless consumers of a topic, as its producer tracks them."""

from collections.abc import Iterable
from dataclasses import dataclass

from ldo_service.transport.flow_control import Credit

from .actor import UNLIMITED


@dataclass
class Consumer:
    """State of one consumer of a topic, as its producer knows it."""

    alive: bool = False
    handled: int = 0  # Offset of the first message that it has not handled.
    arrived: int = 0  # Offset of the first message that it has not received.
    limit: int = 0  # Offset of the first message that exceeds its window.
    repeated_from: int = -1  # Offset at which the last retransmission began; -1: none.
    repeated_at_s: float = 0.0  # Event-loop time of the last retransmission.
    shut_since_s: float | None = None  # Event-loop time at which its window became full.


class Consumers:
    """Connected and required consumers of a topic, and the credit that they grant together.

    Consumers in `expected` are required: they must not miss a message. The producer therefore has
    no credit while one of them is disconnected. Other consumers limit the credit only while they
    are connected. The argument `seq` of all methods is the offset of the producer's next message.
    """

    def __init__(self, expected: Iterable[str], handled: int = 0) -> None:
        """Initialize with the required consumers.

        Args:
            expected: Names of the required consumers.
            handled: Each required consumer has handled every message before this offset.
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
        """Return the offset of the first message that some consumer has not handled."""
        return min((c.handled for c in self._known.values()), default=seq)

    def all_received(self, seq: int) -> bool:
        """Return whether every consumer has received every message before `seq`."""
        return all(c.arrived >= seq for c in self._known.values())

    def next_seq_by_consumer(self) -> dict[str, int]:
        """Return the offset of the next message for each consumer, by name."""
        return {name: consumer.handled for name, consumer in self._known.items()}

    def join(self, name: str, seq: int) -> None:
        """Connect a consumer that sent a hello.

        A new consumer starts at `seq`. A known one receives again what it has not handled.
        """
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
        """Mark a consumer as disconnected.

        The producer forgets it, unless it is required. A required consumer then blocks the producer
        until it connects again.
        """
        consumer = self._known[name]
        consumer.alive, consumer.shut_since_s = False, None
        if name not in self.expected:
            del self._known[name]

    def stalled(self, now_s: float, patience_s: float, seq: int) -> list[str]:
        """Return the connected consumers whose window has been full for over `patience_s`."""
        names: list[str] = []
        for name, consumer in self._known.items():
            if consumer.alive and consumer.limit <= seq:
                if consumer.shut_since_s is None:
                    consumer.shut_since_s = now_s
                if now_s - consumer.shut_since_s > patience_s:
                    names.append(name)
        return names

    def evict(self, name: str) -> None:
        """Treat a stalled consumer as disconnected until it handles another message."""
        self._evicted[name] = self._known[name].handled
        self.leave(name)

    def is_still_stuck(self, grant: Credit) -> bool:
        """Return whether the consumer was evicted and has handled no message since.

        Credit messages alone are no progress, because a consumer repeats them with each heartbeat.
        """
        return grant.handled <= self._evicted.get(grant.consumer, -1)
