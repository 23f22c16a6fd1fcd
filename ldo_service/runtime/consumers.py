"""State of the lossless consumers of a topic, as known to the producer of the topic."""

from collections.abc import Iterable
from dataclasses import dataclass

from ldo_service.transport.flow_control import ConsumerHello, Credit

from .actor import UNLIMITED


@dataclass
class Consumer:
    """State of one lossless consumer, as the producer of the topic knows it.

    The producer updates the state when a hello or a credit message of the consumer arrives.
    """

    # True: the producer waits for the consumer's credit. False: the consumer has policy Backlog.
    is_awaited: bool = True
    alive: bool = False  # The consumer is connected.
    nonce: int = 0  # Nonce of the consumer's last hello; 0 before it.
    handled: int = 0  # Offset of the first message that the consumer has not handled.
    arrived: int = 0  # Offset of the first message that the consumer has not received.
    limit: int = 0  # Offset of the first message that exceeds the consumer's window.
    repeated_from: int = -1  # Offset at which the last retransmission began; -1 if there was none.
    repeated_at_s: float = 0.0  # Event-loop time of the last retransmission.
    # Time of the stage's `RunningClock` at which the window was found full, seconds; None while
    # it is not full.
    shut_since_s: float | None = None
    # Offset after the last message that was sent to a consumer with policy Backlog. This field and
    # the next two are unused for other consumers.
    pushed: int = 0
    # Offset of the first message that has not arrived, and a time at which it was certainly sent
    # (event-loop time). Messages sent after it do not change this time.
    missing_seq: int = -1
    missing_since_s: float = 0.0


class Consumers:
    """Connected and required consumers of a topic, and the credit that they grant together.

    Consumers in `expected` are required: they must not miss a message. Each consumer has one of two
    policies:

    - `Lossless`: The producer waits until the consumer grants credit: the number of messages that
      the producer may send. While a required consumer is disconnected, the producer has no credit.
      A consumer that is not required limits the credit only while it is connected.
    - `Backlog`: The producer never waits for the consumer. The messages that the consumer has not
      handled are stored on disk: the backlog. The credit of the consumer only decides how many
      messages of the backlog the producer sends next.
    """

    def __init__(
        self, expected: Iterable[str], handled: int = 0, with_backlog: Iterable[str] = ()
    ) -> None:
        """Initialize with the required consumers.

        Args:
            expected: Names of the required consumers.
            handled: Each required consumer has handled every message before this offset.
            with_backlog: Names of the consumers with policy `Backlog`.
        """
        self.with_backlog = frozenset(with_backlog)
        self._known = {
            name: Consumer(is_awaited=name not in self.with_backlog, handled=handled)
            for name in sorted(expected)  # The order of a set differs between processes.
        }
        self.expected = frozenset(self._known)
        self._evicted: dict[str, int] = {}  # Value of `handled` at the eviction, by consumer.

    def __len__(self) -> int:
        return len(self._known)

    @property
    def has_backlogs_only(self) -> bool:
        """True if there are required consumers, and all of them have policy `Backlog`."""
        return bool(self.expected) and self.expected <= self.with_backlog

    def __contains__(self, name: str) -> bool:
        return name in self._known

    def credits(self, seq: int) -> int:
        """Return the number of messages that may be sent now without waiting for a consumer.

        The result is UNLIMITED if the producer need not wait for any consumer.

        Args:
            seq: Offset of the producer's next message.
        """
        awaited = [c for c in self._known.values() if c.is_awaited]
        limits = [c.limit - seq if c.alive else 0 for c in awaited]
        return max(0, min(limits, default=UNLIMITED))

    def window_room(self, seq: int) -> int:
        """Return the number of messages, from `seq` on, that fit into the window of every consumer.

        Consumers with policy `Backlog` count too. The result is 0 if a consumer is disconnected, or
        if there are no consumers.

        Args:
            seq: Offset of the producer's next message.
        """
        limits = [c.limit - seq if c.alive else 0 for c in self._known.values()]
        return max(0, min(limits, default=0))

    def handled(self, seq: int) -> int:
        """Return the offset of the first message that at least one consumer has not handled.

        Args:
            seq: Offset of the producer's next message. It is the result if there are no consumers.
        """
        return min((c.handled for c in self._known.values()), default=seq)

    def all_received(self, seq: int, *, awaited_only: bool = False) -> bool:
        """Return whether every consumer has received every message before `seq`.

        A connected consumer with policy `Backlog` only needs the messages that fit into its window.
        The other messages stay in the backlog on disk.

        Args:
            seq: Offset of the producer's next message.
            awaited_only: Ignore the consumers with policy `Backlog`.
        """
        awaited = [c for c in self._known.values() if c.is_awaited]
        others = [c for c in self._known.values() if not c.is_awaited and c.alive]
        has_awaited = all(c.arrived >= seq for c in awaited)
        has_others = awaited_only or all(c.arrived >= min(seq, c.limit) for c in others)
        return has_awaited and has_others

    def behind(self, seq: int) -> dict[str, int]:
        """Return the number of unhandled messages of each consumer with policy `Backlog`, by name.

        Args:
            seq: Offset of the producer's next message.
        """
        return {name: seq - c.handled for name, c in self._known.items() if not c.is_awaited}

    def next_seq_by_consumer(self) -> dict[str, int]:
        """Return the offset of the first message to send to each consumer, by name."""
        return {name: consumer.handled for name, consumer in self._known.items()}

    def nonces(self) -> dict[str, int]:
        """Return the nonce of the last hello of each consumer that sent one, by name."""
        return {name: consumer.nonce for name, consumer in self._known.items() if consumer.nonce}

    def join(self, hello: ConsumerHello, seq: int) -> None:
        """Connect a consumer that sent a hello.

        A new consumer starts at the next message. A known consumer receives again all messages that
        it has not handled.

        Args:
            hello: The hello of the consumer.
            seq: Offset of the producer's next message.
        """
        name = hello.consumer
        self._evicted.pop(name, None)
        consumer = self._known.setdefault(name, Consumer(handled=seq))
        consumer.nonce = hello.nonce or consumer.nonce
        consumer.alive, consumer.shut_since_s, consumer.repeated_from = True, None, -1
        consumer.missing_seq = -1
        consumer.arrived = consumer.limit = consumer.pushed = consumer.handled
        consumer.is_awaited = not (hello.has_backlog or name in self.with_backlog)

    def note_sent(self, seq: int, now_s: float) -> None:
        """Record that message `seq` was published to all consumers at event-loop time `now_s`.

        For a consumer with policy `Backlog`, the message counts as sent only if the window of the
        consumer is not full and all earlier messages were sent to it. Otherwise the consumer
        rejects the message, and the producer sends the message from the backlog on disk later.
        """
        for consumer in self._known.values():
            if not consumer.is_awaited and consumer.pushed == seq < consumer.limit:
                if seq == consumer.arrived:
                    consumer.missing_seq, consumer.missing_since_s = seq, now_s
                consumer.pushed = seq + 1

    def next_of_backlog(self, name: str, seq: int, now_s: float, repeat_after_s: float) -> range:
        """Return the offsets of the messages to send now to a consumer with policy `Backlog`.

        These messages then count as sent.

        Args:
            name: Name of the consumer.
            seq: Offset of the first message that was not published.
            now_s: Event-loop time at which the messages count as sent.
            repeat_after_s: Time after which the first missing message counts as lost, seconds.
                Messages that are sent later do not extend this time.
        """
        consumer = self._known[name]
        if consumer.missing_seq != consumer.arrived:
            consumer.missing_seq, consumer.missing_since_s = consumer.arrived, now_s
        is_overdue = now_s - consumer.missing_since_s > repeat_after_s
        if consumer.pushed < consumer.arrived or is_overdue:
            consumer.pushed = consumer.arrived
        messages = range(consumer.pushed, min(seq, consumer.limit))
        if messages:
            if messages.start == consumer.arrived:
                consumer.missing_since_s = now_s
            consumer.pushed = messages.stop
        return messages

    def skip(self, first: int, since: int = 0) -> bool:
        """Let consumers skip the messages that the producer no longer has.

        Args:
            first: Offset of the first message that the producer still has.
            since: A consumer skips messages only if it has handled all messages before this offset.

        Returns:
            True if a consumer now continues at `first`, and therefore misses messages.
        """
        late = [c for c in self._known.values() if since <= c.handled < first]
        for consumer in late:
            consumer.handled = first
        return bool(late)

    def grant(self, grant: Credit) -> Consumer:
        """Update a known consumer from its credit message, and return the consumer."""
        self._evicted.pop(grant.consumer, None)
        consumer = self._known[grant.consumer]
        consumer.alive = True
        consumer.handled = max(consumer.handled, grant.handled)
        consumer.arrived = grant.arrived  # May decrease: the consumer may have restarted.
        if grant.limit > consumer.limit or grant.waits_for_disk:
            consumer.limit, consumer.shut_since_s = max(grant.limit, consumer.limit), None
        return consumer

    def leave(self, name: str) -> bool:
        """Mark a consumer as disconnected.

        The producer forgets a consumer that is not required. If a required consumer with policy
        `Lossless` disconnects, the producer waits until this consumer connects again.

        Returns:
            True if the producer now waits for the consumer.
        """
        consumer = self._known[name]
        consumer.alive, consumer.shut_since_s = False, None
        if name not in self.expected:
            del self._known[name]
        return name in self.expected and consumer.is_awaited

    def stalled(self, now_s: float, patience_s: float, seq: int) -> list[str]:
        """Return the names of the consumers whose window has been full for over `patience_s`.

        The window is the limit of unhandled messages. Only connected consumers with policy
        `Lossless` count.

        Args:
            now_s: Current time of the stage's `RunningClock`, seconds.
            patience_s: Time that a window may be full, seconds.
            seq: Offset of the producer's next message.
        """
        names: list[str] = []
        for name, consumer in self._known.items():
            if consumer.alive and consumer.is_awaited and consumer.limit <= seq:
                if consumer.shut_since_s is None:
                    consumer.shut_since_s = now_s
                if now_s - consumer.shut_since_s > patience_s:
                    names.append(name)
        return names

    def evict(self, name: str) -> None:
        """Treat a stalled consumer as disconnected.

        The consumer stays disconnected until it sends a credit message for which `is_still_stuck`
        is False.
        """
        self._evicted[name] = self._known[name].handled
        self.leave(name)

    def is_still_stuck(self, grant: Credit) -> bool:
        """Return whether a credit message shows that an evicted consumer is still stuck.

        A consumer is stuck if it has received unhandled messages, but has handled none since the
        eviction. Credit messages are no progress: a consumer repeats them with each heartbeat. A
        consumer that has handled all received messages waits for messages that the network has
        lost. It must be reconnected, because the producer retransmits only to connected consumers.
        """
        has_work = grant.handled < grant.arrived
        return has_work and grant.handled <= self._evicted.get(grant.consumer, -1)
