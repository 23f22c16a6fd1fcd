"""The lossless consumers of a topic, as its producer knows them."""

from collections.abc import Iterable
from dataclasses import dataclass

from ldo_service.transport.flow_control import Credit

from .actor import UNLIMITED


@dataclass
class Consumer:
    alive: bool = False
    handled: int = 0
    arrived: int = 0
    limit: int = 0
    repeated_from: int = -1  # where the last repetition began, and when
    repeated_at_s: float = 0.0
    shut_since_s: float | None = None  # when its window was first seen shut


class Consumers:
    """Who has joined, what each has handled, and how many messages all of them take.

    Consumers that are `expected` must not miss a message: while one of them is not there, there is
    no room. Others count while they live. `seq` is always that of the next message.
    """

    def __init__(self, expected: Iterable[str], handled: int = 0) -> None:
        """Each of those expected has handled all before `handled`."""
        self._known = {name: Consumer(handled=handled) for name in expected}
        self.expected = frozenset(self._known)
        self._evicted: dict[str, int] = {}  # what each had handled when patience was over

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, name: str) -> bool:
        return name in self._known

    def room(self, seq: int) -> int:
        limits = [c.limit - seq if c.alive else 0 for c in self._known.values()]
        return max(0, min(limits, default=UNLIMITED))

    def handled(self, seq: int) -> int:
        """Every message before has been handled by all."""
        return min((c.handled for c in self._known.values()), default=seq)

    def all_received(self, seq: int) -> bool:
        """Whether everything sent has arrived everywhere."""
        return all(c.arrived >= seq for c in self._known.values())

    def next_seq_by_consumer(self) -> dict[str, int]:
        """By name: the first message that each is to get."""
        return {name: consumer.handled for name, consumer in self._known.items()}

    def join(self, name: str, seq: int) -> None:
        """It joined, or joined again: it gets what it has not handled."""
        self._evicted.pop(name, None)
        consumer = self._known.setdefault(name, Consumer(handled=seq))
        consumer.alive, consumer.shut_since_s, consumer.repeated_from = True, None, -1
        consumer.arrived = consumer.limit = consumer.handled

    def grant(self, grant: Credit) -> Consumer:
        self._evicted.pop(grant.consumer, None)
        consumer = self._known[grant.consumer]
        consumer.alive = True
        consumer.handled = max(consumer.handled, grant.handled)
        consumer.arrived = grant.arrived  # not the most ever: a successor may have less
        if grant.limit > consumer.limit or grant.waits_for_disk:
            consumer.limit, consumer.shut_since_s = max(grant.limit, consumer.limit), None
        return consumer

    def leave(self, name: str) -> None:
        """It holds nothing up any more, unless it must not miss a message."""
        consumer = self._known[name]
        consumer.alive, consumer.shut_since_s = False, None
        if name not in self.expected:
            del self._known[name]

    def stalled(self, now_s: float, patience_s: float, seq: int) -> list[str]:
        """Those that live, and whose window has been shut for longer than that."""
        names: list[str] = []
        for name, consumer in self._known.items():
            if consumer.alive and consumer.limit <= seq:
                if consumer.shut_since_s is None:
                    consumer.shut_since_s = now_s
                if now_s - consumer.shut_since_s > patience_s:
                    names.append(name)
        return names

    def evict(self, name: str) -> None:
        self._evicted[name] = self._known[name].handled
        self.leave(name)

    def is_still_stuck(self, grant: Credit) -> bool:
        """Whether it was evicted and has handled nothing since: its heartbeats alone count not."""
        return grant.handled <= self._evicted.get(grant.consumer, -1)
