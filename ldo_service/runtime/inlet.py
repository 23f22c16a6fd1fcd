"""One input of an actor: what waits, what is dropped, what is asked for again."""

from collections import deque
from dataclasses import dataclass, field

from ldo_service.schemas import InputCount
from ldo_service.transport.flow_control import (
    EXTERNAL_HEADER,
    ConsumerHello,
    Credit,
    Header,
    InletPosition,
    SequenceTracker,
)

from .actor import In, Latest, Lossless


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """One message, as it arrived."""

    port: In
    header: Header
    body: memoryview


@dataclass
class Inlet:
    """An input of policy Latest."""

    port: In
    waiting: deque[Delivery] = field(default_factory=deque)
    delivered: int = 0
    dropped: int = 0
    rejected: int = 0
    gaps: int = 0
    peak: int = 0
    paused: int = 0
    numbers: SequenceTracker = field(default_factory=SequenceTracker)

    def number(self, header: Header) -> None:
        """Count those that never came."""
        if header is not EXTERNAL_HEADER:
            self.numbers.observe(header)

    def accept(self, header: Header) -> bool:  # noqa: ARG002
        """Whether to take the message in."""
        return True

    def offer(self, delivery: Delivery) -> list[Delivery]:
        """Take a delivery in; what had to make room for it."""
        self.waiting.append(delivery)
        displaced = self._overflow(delivery)
        for old in displaced:
            self.waiting.remove(old)
        self.dropped += len(displaced)
        self.peak = max(self.peak, len(self.waiting))
        return displaced

    def _overflow(self, newest: Delivery) -> list[Delivery]:
        policy = self.port.policy
        assert isinstance(policy, Latest)
        if not policy.per_key:
            return [self.waiting[0]] if len(self.waiting) > policy.depth else []
        by_key: dict[str, list[Delivery]] = {}  # the key that has waited longest comes first
        for delivery in self.waiting:
            by_key.setdefault(delivery.header.key, []).append(delivery)
        same = by_key[newest.header.key]
        if len(same) > policy.depth:
            return same[:1]
        return next(iter(by_key.values())) if len(by_key) > policy.max_keys else []

    def done(self, delivery: Delivery, rejected: bool) -> None:  # noqa: ARG002
        self.delivered += not rejected
        self.rejected += rejected

    def discard_backlog(self) -> None:
        """What waits is not taken any more: the stage is held."""
        self.paused += len(self.waiting)
        self.waiting.clear()

    def reset(self) -> None:
        """Forget what waits."""
        self.waiting.clear()

    def counts(self) -> InputCount:
        return InputCount(
            topic=self.port.topic.name,
            delivered=self.delivered,
            dropped=self.dropped,
            rejected=self.rejected,
            gaps=self.gaps,
            queued=len(self.waiting),
            peak_queued=self.peak,
            dropped_paused=self.paused,
            lost=self.numbers.lost,
        )


@dataclass
class LosslessInlet(Inlet):
    """The consumer's end of a link: order, gaps and grants."""

    epoch: int = 0  # of the producer that welcomed us; 0 before
    handled: int = 0
    arrived: int = 0
    gap: bool = False
    is_connected: bool = False  # by the producer that is there now

    @property
    def window(self) -> int:
        assert isinstance(self.port.policy, Lossless)
        return self.port.policy.window

    def welcome(self, epoch: int, start: int) -> int:
        """Numbering begins here, unless we know already; how many messages are lost by it."""
        known, joins = epoch == self.epoch, not self.is_connected
        self.is_connected = True
        if known and start <= self.arrived:
            self.gap = self.gap or joins
            return 0
        lost = start - self.arrived if known else 0
        self.epoch, self.handled, self.arrived = epoch, start, start
        self.gap = True  # ask for what was sent before we were known
        return lost

    def accept(self, header: Header) -> bool:
        """Take the next message, if there is room; what was skipped will be sent again."""
        if header.epoch != self.epoch or header.seq < self.arrived:
            return False
        self.gap = header.seq > self.arrived or len(self.waiting) >= self.window
        if self.gap:
            self.gaps += 1
            return False
        self.arrived += 1
        return True

    def discard_backlog(self) -> None:
        """Nothing: it waits in its window."""

    def reset(self) -> None:
        """Forget what waits and who sent it: whoever sends has to welcome us again."""
        super().reset()
        self.epoch = self.handled = self.arrived = 0
        self.gap = self.is_connected = False

    def _overflow(self, newest: Delivery) -> list[Delivery]:  # noqa: ARG002
        return []  # `accept` keeps to the window

    def done(self, delivery: Delivery, rejected: bool) -> None:
        super().done(delivery, rejected)
        if delivery.header.epoch == self.epoch:
            self.handled = max(self.handled, delivery.header.seq + 1)

    def resume_from(self, past: InletPosition) -> None:
        """Where a predecessor stopped."""
        self.epoch, self.handled, self.arrived = past.epoch, past.handled, past.handled

    def position(self, being_handled: Delivery | None) -> InletPosition:
        """For a successor, as if that delivery had been handled."""
        handled = self.handled
        if being_handled is not None and being_handled.header.epoch == self.epoch:
            handled = max(handled, being_handled.header.seq + 1)
        return InletPosition(self.epoch, handled)

    def grant(self, consumer: str, *, waits_for_disk: bool = False) -> ConsumerHello | Credit:
        if not self.is_connected:
            return ConsumerHello(consumer)
        limit = self.handled + self.window
        where = self.epoch, self.handled, self.arrived, limit
        return Credit(consumer, *where, self.gap, waits_for_disk)
