"""Outlet: the sending half of a topic."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress

import msgspec

from ldo_service.schemas import Message, OutputCount
from ldo_service.transport.flow_control import (
    ConsumerHello,
    Credit,
    Header,
    OutletPosition,
    ProducerHello,
    UnackedMessage,
    credit_key,
    data_key,
    decode_request,
    encode_link,
    producer_hello_key,
    retransmit_key,
)
from ldo_service.transport.interface import Publisher, Transport, call_soon

from .actor import Out
from .consumers import Consumer, Consumers
from .last_value import LastValue
from .outbox import Outbox
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)


class Outlet:
    """Sending half of a topic, with credit-based flow control for lossless consumers.

    Credit is the number of messages that a consumer allows the outlet to send. The outlet numbers
    messages, waits for credit from each consumer with policy `Lossless`, and retransmits lost
    messages. Required consumers (`expected`) must not miss a message: the outlet also waits while
    one of them is disconnected. The outlet of a nonblocking port never waits, because the actor
    checks the credit before it yields a message.

    The outlet never waits for a consumer with policy `Backlog`. It stores the unhandled messages on
    disk, and sends them when the consumer grants credit.
    """

    # Time after which a message counts as lost, seconds: half a credit period. A shorter time would
    # retransmit messages that are still on their way.
    REPEAT_AFTER_S = 0.25
    # Maximum wait of `flush` for consumers with policy `Backlog`, seconds: two credit periods.
    FLUSH_BACKLOG_S = 1.0

    def __init__(
        self,
        port: Out,
        source: str,
        epoch: int,
        transport: Transport,
        expected: Iterable[str] = (),
        evict_after_s: float = 30.0,
        on_evicted: Callable[[str], None] = lambda _consumer: None,
        past: OutletPosition | None = None,
        *,
        with_backlog: Iterable[str] = (),
        outbox: Outbox | None = None,
    ) -> None:
        """Open the topic on the network.

        Args:
            port: The output of the actor.
            source: Name of the actor.
            epoch: Random number that identifies the numbering; unused if `past` is given.
            transport: The network.
            expected: Names of the required consumers.
            evict_after_s: Time after which a consumer with a full window is evicted, seconds.
            on_evicted: Called with the name of an evicted consumer.
            past: Position of the previous process: its next offset, and messages to retransmit.
            with_backlog: Names of the required consumers with policy `Backlog`.
            outbox: Storage of unhandled messages; by default in memory.
        """
        self.port, self.topic = port, port.topic
        past = past or OutletPosition(epoch, 0)
        self._source, self._epoch = source, past.epoch
        self._evict_after_s, self._on_evicted = evict_after_s, on_evicted
        self._loop = asyncio.get_running_loop()
        self._seq = past.seq
        self._sent_at_s = self._loop.time()
        self._consumers = Consumers(expected, past.handled, with_backlog)
        self.outbox = outbox or Outbox(past.unhandled)
        self._unsent = deque[UnackedMessage]()
        self._changed = asyncio.Event()  # The state of a consumer changed.
        self._ahead: set[str] = set()  # Consumers with messages that this outlet never sent.
        self._repeating: asyncio.Task[None] | None = None
        # Publisher of each consumer's backlog, and the task that is sending on it, by consumer.
        self._backlogs: dict[str, Publisher] = {}
        self._pushing: dict[str, asyncio.Task[None]] = {}
        self._closed, self._last_value = False, LastValue()
        self._malformed = LogLimit(LOG_PERIOD_S)
        self.sent = self.waited = self.repeated = self.evicted = 0
        self._open(transport)

    def _open(self, transport: Transport) -> None:
        self._transport, topic = transport, self.topic.name
        self._publisher = transport.publisher(data_key(topic))
        self._retransmissions = transport.publisher(retransmit_key(topic))
        self._hellos = transport.publisher(producer_hello_key(topic))
        transport.subscribe(credit_key(topic), self._requested)
        transport.watch_liveliness(self._presence)
        if self.topic.is_state:
            transport.serve_queries(data_key(topic), lambda: self._last_value.parts)
        self._post_hellos()  # Running consumers then connect immediately.

    # --- sending ----------------------------------------------------------------------------
    def credits(self) -> int:
        """Return the number of messages that may be sent now; 0 while staged messages wait.

        Consumers with policy `Backlog` limit this number only if the port is nonblocking and all
        required consumers have this policy. Messages then fit into their queues; no backlog grows.
        """
        if self._unsent:
            return 0
        if self.port.is_nonblocking and self._consumers.has_backlogs_only:
            return self._consumers.window_room(self._seq)
        return self._consumers.credits(self._seq)

    async def send(self, message: Message, body: bytes) -> None:
        """Send one message; wait for credit unless the port is nonblocking."""
        self.stage_message(message, body)
        await self.commit()

    def stage_message(self, message: Message, body: bytes) -> None:
        """Assign the next number to a message, and hold it until `commit` or `rollback`."""
        key = str(getattr(message, self.topic.key)) if self.topic.key else ""
        header = encode_link(Header(self._source, self._epoch, self._seq, message.stamp_ns, key))
        held = UnackedMessage(self._seq, header, body)
        self._unsent.append(held)
        if self._consumers:
            self.outbox.add(held)
        if self.topic.is_state:
            self._last_value.add(message, header, body)
        self._seq += 1

    async def commit(self) -> None:
        """Send the staged messages in order, and wait for credit unless the port is nonblocking."""
        while self._unsent:
            if not self.port.is_nonblocking:
                await self._wait_for_credit()
            held = self._unsent.popleft()
            self.sent += 1
            self._sent_at_s = self._loop.time()
            self._consumers.note_sent(held.seq, self._sent_at_s)
            await self._publisher.send(held.header, held.body)

    def rollback(self) -> None:
        """Discard the staged messages, and reuse their numbers for later messages."""
        self._seq = self._next
        self.outbox.truncate(self._seq)
        self._unsent.clear()

    def store(self) -> None:
        """Write unhandled messages to the outbox on disk; may be called on any thread.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        self.outbox.store()

    @property
    def _next(self) -> int:
        """Offset of the first message that was not sent."""
        return self._unsent[0].seq if self._unsent else self._seq

    async def _wait_for_credit(self) -> None:
        self.waited += self._consumers.credits(self._next) == 0
        while self._consumers.credits(self._next) == 0:
            await self._change()

    async def flush(self) -> None:
        """Wait until every consumer with policy `Lossless` has received all messages.

        Then wait at most `FLUSH_BACKLOG_S` for `Backlog` consumers, which may be stopped.
        """
        self._post_hellos()  # Each consumer immediately replies with its credit.
        while not self._consumers.all_received(self._seq, awaited_only=True):
            await self._change()
        with suppress(TimeoutError):
            async with asyncio.timeout(self.FLUSH_BACKLOG_S):
                while not self._consumers.all_received(self._seq):
                    await self._change()

    async def _change(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    @property
    def handled(self) -> int:
        """Number of the first message that at least one consumer has not handled."""
        return min(self._consumers.handled(self._seq), self._seq)

    def position(self) -> OutletPosition | None:
        """Return what the next start needs: the unhandled messages, and the next message number.

        The result is None if the topic has no required consumer.
        """
        if not self._consumers.expected:
            return None
        logged_from = self.outbox.first_needed(self.handled) if self.outbox.is_logged else None
        return OutletPosition(self._epoch, self._seq, self.outbox.in_memory, logged_from)

    # --- consumers --------------------------------------------------------------------------
    def _requested(self, _header: bytes, body: memoryview) -> None:
        """Decode a hello or credit on any thread, and handle it on the event loop."""
        try:
            request = decode_request(body)
        except msgspec.DecodeError as error:
            if self._malformed.is_due():
                log.warning("%s: malformed credit message ignored: %s. Do all programs on this "
                            "network run the same version?", self.topic.name, error)  # fmt: skip
            return
        call_soon(self._loop, self._take_request, request)

    def _take_request(self, request: ConsumerHello | Credit) -> None:
        name = request.consumer
        if self._closed:
            return
        if isinstance(request, Credit) and request.epoch == self._epoch:
            if self._consumers.is_still_stuck(request):
                return
            if name in self._consumers:
                self._granted(request)
                return
        hello = request if isinstance(request, ConsumerHello) else ConsumerHello(name)
        self._consumers.join(hello, self._seq)
        self._consumers.skip(self.outbox.first(self._seq))
        self._post_hellos()

    def reset(self, epoch: int) -> None:
        """Restart message numbers at 0 in a new epoch; all consumers must connect again."""
        self._cancel_repeating()
        self._epoch, self._seq = epoch, 0
        past = self._consumers
        self._consumers = Consumers(past.expected, with_backlog=past.with_backlog)
        self.outbox.restart(epoch)
        for forgotten in (self._unsent, self._ahead, self._last_value):
            forgotten.clear()
        self._post_hellos()

    def _post_hellos(self) -> None:
        starts, nonces = self._consumers.next_seq_by_consumer(), self._consumers.nonces()
        self._hellos.post(b"", encode_link(ProducerHello(self._epoch, starts, nonces)))

    def _granted(self, grant: Credit) -> None:
        if grant.arrived > self._seq:
            self._warn_stale_state(grant)
            return
        consumer = self._consumers.grant(grant)
        self._forget_handled()
        if not consumer.is_awaited:
            self._push_backlog(grant.consumer)
        elif consumer.arrived < self._next:
            self._retransmit(consumer, grant.gap)
        self._changed.set()

    def _warn_stale_state(self, grant: Credit) -> None:
        """Log once that a consumer has received messages that this outlet never sent."""
        if grant.consumer not in self._ahead:
            log.error(
                "%s: consumer %s has received %d messages, but only %d were sent. The state of the "
                "consumer is newer than the state of the producer %s, so the consumer receives no "
                "messages. Restore both states from one copy, or start with an empty map by "
                "`ldo control reset`.",
                self.topic.name, grant.consumer, grant.arrived, self._seq, self._source,
            )  # fmt: skip
        self._ahead.add(grant.consumer)

    def _forget_handled(self) -> None:
        self.outbox.forget(self._consumers.handled(self._seq))

    # --- retransmission ---------------------------------------------------------------------
    def _push_backlog(self, name: str) -> None:
        """Send to a consumer those messages of its backlog on disk that fit into its window."""
        if name in self._pushing:
            return
        if self._consumers.skip(self.outbox.first(self._seq)):
            self._post_hellos()  # The hello has the new first message of the backlog.
            return
        messages = self._consumers.next_of_backlog(
            name, self._next, self._loop.time(), self.REPEAT_AFTER_S
        )
        if messages:
            self.repeated += len(messages)
            self._pushing[name] = self._loop.create_task(self._push(name, messages))

    async def _push(self, name: str, messages: range) -> None:
        try:
            if name not in self._backlogs:
                key = retransmit_key(self.topic.name, name)
                self._backlogs[name] = self._transport.publisher(key)
            await self._send_again(messages, self._backlogs[name])
        finally:
            if self._pushing.get(name) is asyncio.current_task():
                del self._pushing[name]

    def _retransmit(self, consumer: Consumer, gap: bool) -> None:
        """Retransmit the messages that a consumer has not received.

        If the consumer has not reported a gap, the outlet first waits `REPEAT_AFTER_S` seconds,
        because the messages may still be on their way.
        """
        now = self._loop.time()
        recently = now - consumer.repeated_at_s < self.REPEAT_AFTER_S
        if gap:
            is_on_its_way = recently and consumer.repeated_from == consumer.arrived
        else:
            is_on_its_way = recently or now - self._sent_at_s < self.REPEAT_AFTER_S
        if is_on_its_way or self._repeating is not None:
            return
        consumer.repeated_from, consumer.repeated_at_s = consumer.arrived, now
        lost = range(consumer.arrived, min(self._next, consumer.limit))
        self.repeated += len(lost)
        self._repeating = self._loop.create_task(self._resend(lost))

    async def _resend(self, lost: range) -> None:
        try:
            await self._send_again(lost, self._retransmissions)
        finally:
            if self._repeating is asyncio.current_task():
                self._repeating = None

    async def _send_again(self, numbers: range, publisher: Publisher) -> None:
        """Send messages from the outbox; stop at the first one that the outbox has lost."""
        for seq in numbers:
            message = await asyncio.to_thread(self.outbox.read, seq)
            if message is None:
                self._skip_lost(seq)
                return
            await publisher.send(message.header, message.body)

    def _skip_lost(self, seq: int) -> None:
        """Let consumers skip message `seq`, which is lost, if they handled all earlier messages."""
        if self._consumers.skip(self.outbox.after(seq, self._seq), since=seq):
            self._post_hellos()

    def _cancel_repeating(self) -> None:
        for task in (self._repeating, *self._pushing.values()):
            if task is not None:
                task.cancel()
        self._repeating = None
        self._pushing.clear()  # A task cancelled before its start does not remove its entry.

    def _presence(self, name: str, alive: bool) -> None:
        if not alive and not self._closed and name in self._consumers:
            if self._consumers.leave(name):
                log.warning("%s: consumer %s disconnected; waiting for its restart.",
                            self.topic.name, name)  # fmt: skip
            self._forget_handled()
            self._changed.set()

    def evict_stalled(self, now_s: float) -> None:
        """Evict consumers whose window of unhandled messages is full for over `evict_after_s`."""
        overdue = self._consumers.stalled(now_s, self._evict_after_s, self._next)
        for name in overdue:
            log.error(
                "%s: consumer %s evicted: it took no message for %.0f s "
                "(supervision.evict_after_s). If the consumer is a child process of the service, "
                "the service restarts it. Any other consumer is ignored until it handles a "
                "message or waits for one.",
                self.topic.name, name, self._evict_after_s,
            )  # fmt: skip
            self.evicted += 1
            self._consumers.evict(name)
            self._forget_handled()
            self._changed.set()
            self._on_evicted(name)

    # --- counters and close ----------------------------------------------------------------
    def counts(self) -> OutputCount:
        """Return the message counters of this topic, for the health message of the stage."""
        return OutputCount(
            topic=self.topic.name,
            sent=self.sent,
            backpressure_waits=self.waited,
            evicted_consumers=self.evicted,
            retransmitted=self.repeated,
            behind=self._consumers.behind(self._seq),
            backlog_mb=1e-6 * self.outbox.size_bytes,
            backlog_dropped=self.outbox.dropped,
            backlog_max_mb=1e-6 * (self.outbox.max_bytes or 0),
        )

    def close(self) -> None:
        """Cancel all retransmissions and close the topic on the network."""
        self._closed = True
        self._cancel_repeating()
        own = self._publisher, self._retransmissions, self._hellos
        for publisher in (*own, *self._backlogs.values()):
            publisher.close()
