"""Inputs of an actor: queue, drop policy, and requests for retransmission."""

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
    new_nonce,
)

from .actor import Backlog, In, Latest, Lossless

# Number of hellos of a producer in a row that an unconnected input replies to at once. The first
# reply connects, unless a message is lost or arrives late. A producer that never answers, such as
# one of an older version, replies to each reply.
MAX_PROMPT_REPLIES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """Message as it arrived, with its header; the body is not decoded."""

    port: In
    header: Header
    body: memoryview


@dataclass
class Inlet:
    """Queue and counters of an input.

    This class is for inputs with policy `Latest`. Its subclass `LosslessInlet` is for other inputs.
    """

    port: In
    waiting: deque[Delivery] = field(default_factory=deque)  # Queued messages, oldest first.
    delivered: int = 0  # Messages that were handled.
    dropped: int = 0  # Messages dropped because newer ones came.
    rejected: int = 0  # Malformed or too large messages.
    # Messages that came out of order or when the window was full; counted by `LosslessInlet`.
    gaps: int = 0
    peak: int = 0  # Maximum length of the queue so far.
    paused: int = 0  # Messages dropped while the stage was paused.
    numbers: SequenceTracker = field(default_factory=SequenceTracker)  # Counter of lost messages.

    def number(self, header: Header) -> None:
        """Count the messages that were lost before the one with this header."""
        if header is not EXTERNAL_HEADER:
            self.numbers.observe(header)

    def accept(self, header: Header) -> bool:  # noqa: ARG002
        """Return whether to queue the message with this header."""
        return True

    def offer(self, delivery: Delivery) -> list[Delivery]:
        """Queue a delivery, and return the older deliveries that are dropped for it."""
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
        by_key: dict[str, list[Delivery]] = {}  # The key with the oldest message comes first.
        for delivery in self.waiting:
            by_key.setdefault(delivery.header.key, []).append(delivery)
        same = by_key[newest.header.key]
        if len(same) > policy.depth:
            return same[:1]
        return next(iter(by_key.values())) if len(by_key) > policy.max_keys else []

    @property
    def waiting_bytes(self) -> int:
        """Size of the queued messages, bytes."""
        return sum(delivery.body.nbytes for delivery in self.waiting)

    def drop_oldest(self) -> Delivery:
        """Drop and return the oldest queued message."""
        self.dropped += 1
        return self.waiting.popleft()

    def done(self, delivery: Delivery, rejected: bool) -> None:  # noqa: ARG002
        """Count a delivery that was handled or rejected."""
        self.delivered += not rejected
        self.rejected += rejected

    def discard_backlog(self) -> None:
        """Drop the queued messages of a paused stage, and count them in `paused`."""
        self.paused += len(self.waiting)
        self.waiting.clear()

    def reset(self) -> None:
        """Clear the queue."""
        self.waiting.clear()

    def counts(self) -> InputCount:
        """Return the counters for the health message."""
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
    """Lossless input, which checks the order of messages, reports gaps and grants credit."""

    epoch: int = 0  # Epoch of the connected producer; 0 before the first hello.
    handled: int = 0  # Offset of the first message that was not handled.
    arrived: int = 0  # Offset of the first message that was not received.
    gap: bool = False  # A message is missing; the producer should retransmit.
    is_connected: bool = False  # The current producer has answered the hello of this input.
    nonce: int = field(default_factory=new_nonce)  # Number that the next answer must contain.
    unanswered: int = 0  # Hellos of the producer since the last one that connected this input.

    @property
    def window(self) -> int:
        """Maximum number of messages in the queue."""
        assert isinstance(self.port.policy, Lossless)
        return self.port.policy.window

    def welcome(self, epoch: int, start: int, nonce: int) -> int:
        """Handle the hello of the producer.

        A hello with a new epoch may be older than the connection, because the network may deliver
        messages out of order. The input therefore connects to a new epoch only if the hello
        answers the last hello of this input, which the nonce shows. If it does not, the input sends
        its own hello again, which the producer answers.

        Args:
            epoch: Epoch of the producer. A new epoch restarts the numbering.
            start: Offset of the first message that the producer can send.
            nonce: Nonce of the last hello that the producer received from this input; 0 for none.

        Returns:
            Number of messages that this input has not received and that the producer no longer has.
        """
        known, is_connecting = epoch == self.epoch, not self.is_connected
        if not known and nonce != self.nonce:
            self.is_connected = False
            return 0
        self.is_connected = True
        if not known:
            self.nonce = new_nonce()
        if known and start <= self.arrived:
            self.gap = self.gap or is_connecting
            return 0
        lost = start - self.arrived if known else 0
        self.numbers.add_lost(lost)
        if not (known and self.waiting):  # If messages are queued, `done` advances `handled`.
            self.handled = start
        self.epoch, self.arrived = epoch, start
        self.gap = True  # Request the messages that were sent before the hello.
        return lost

    def should_reply(self) -> bool:
        """Return whether to reply at once to the hello that the producer has just sent.

        If not, the input sends its own hello again with the next heartbeat.
        """
        self.unanswered = 0 if self.is_connected else self.unanswered + 1
        return self.unanswered <= MAX_PROMPT_REPLIES

    def accept(self, header: Header) -> bool:
        """Return whether the message is the next one and fits into the window.

        The producer retransmits a message that is not accepted.
        """
        if header.epoch != self.epoch or header.seq < self.arrived:
            return False
        self.gap = header.seq > self.arrived or len(self.waiting) >= self.window
        if self.gap:
            # The producer of a Backlog input also publishes while the window is full.
            self.gaps += not isinstance(self.port.policy, Backlog)
            return False
        self.arrived += 1
        return True

    def discard_backlog(self) -> None:
        """Do nothing, because a lossless input of a paused stage must keep its messages."""

    def reset(self) -> None:
        """Clear the queue and the connection; the producer must send its hello again."""
        super().reset()
        self.epoch = self.handled = self.arrived = 0
        self.gap = self.is_connected = False
        self.nonce, self.unanswered = new_nonce(), 0

    def _overflow(self, newest: Delivery) -> list[Delivery]:  # noqa: ARG002
        return []  # `accept` enforces the window.

    def done(self, delivery: Delivery, rejected: bool) -> None:
        """Count a delivery and advance the offset of handled messages."""
        super().done(delivery, rejected)
        if delivery.header.epoch == self.epoch:
            self.handled = max(self.handled, delivery.header.seq + 1)
            if not self.waiting:
                self.handled = self.arrived

    def resume_from(self, past: InletPosition) -> None:
        """Continue at the saved position of the previous process."""
        self.epoch, self.handled, self.arrived = past.epoch, past.handled, past.handled

    def position(self, being_handled: Delivery | None) -> InletPosition:
        """Return the position to save.

        Args:
            being_handled: The delivery of the current step, which counts as handled.
        """
        handled = self.handled
        if being_handled is not None and being_handled.header.epoch == self.epoch:
            handled = max(handled, being_handled.header.seq + 1)
        return InletPosition(self.epoch, handled)

    def grant(self, consumer: str, *, waits_for_disk: bool = False) -> ConsumerHello | Credit:
        """Return the message to send to the producer.

        The message is a hello (handshake) until the producer has sent its own hello. After that, it
        is the credit: the range of messages that the producer may send.

        Args:
            consumer: Name of the actor with this input.
            waits_for_disk: True if the stage takes no messages because its disk is full.
        """
        if not self.is_connected:
            return ConsumerHello(consumer, isinstance(self.port.policy, Backlog), self.nonce)
        limit = self.handled + self.window
        where = self.epoch, self.handled, self.arrived, limit
        return Credit(consumer, *where, self.gap, waits_for_disk)
