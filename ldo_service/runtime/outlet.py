"""Outlets: the sending half of a topic, and all outlets of one actor."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import msgspec

from ldo_service.schemas import Message, OutputCount
from ldo_service.schemas.topics import Topic
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
from ldo_service.transport.interface import Transport, call_soon

from .actor import Out
from .consumers import Consumer, Consumers
from .step import Produced

log = logging.getLogger(__name__)


class Outlet:
    """Numbers messages, waits for room at every lossless consumer, sends again what got lost.

    `expected` names consumers that must not miss a message: until each has joined, and again after
    one died, there is no room. Others hold the producer back only while they live. A port that
    never waits sends at once: its actor has looked at `room` before.

    With a `past` it goes on with a predecessor's numbers, and what some expected consumer has not
    handled is sent again.
    """

    REPEAT_AFTER_S = 0.25  # half a grant period: sooner would repeat what is still on its way

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
    ) -> None:
        self.port, self.topic = port, port.topic
        past = past or OutletPosition(epoch, 0)
        self._source, self._epoch = source, past.epoch
        self._evict_after_s, self._on_evicted = evict_after_s, on_evicted
        self._loop = asyncio.get_running_loop()
        self._seq = past.seq
        self._sent_at_s = self._loop.time()
        self._consumers = Consumers(expected, past.handled)
        self._unhandled = deque(past.unhandled)
        self._unsent = deque(past.unhandled)
        self._changed = asyncio.Event()  # something about a consumer
        self._ahead: set[str] = set()  # consumers that know messages we do not
        self._repeating: asyncio.Task[None] | None = None
        self._closed = False
        self._parts: list[tuple[bytes, bytes]] = []  # of a state that is not complete yet
        self._last_value: tuple[tuple[bytes, bytes], ...] = ()
        self.sent = self.waited = self.repeated = self.evicted = 0
        self._open(transport)

    def _open(self, transport: Transport) -> None:
        topic = self.topic.name
        self._publisher = transport.publisher(data_key(topic))
        self._again = transport.publisher(retransmit_key(topic))
        self._welcomes = transport.publisher(producer_hello_key(topic))
        transport.subscribe(credit_key(topic), self._requested)
        transport.watch_liveliness(self._presence)
        if self.topic.is_state:
            transport.serve_queries(data_key(topic), lambda: self._last_value)
        self._post_welcomes()  # consumers that are there already join at once

    # --- sending ----------------------------------------------------------------------------
    def credits(self) -> int:
        """How many messages may be sent now without waiting; none while one is held."""
        return 0 if self._unsent else self._consumers.room(self._seq)

    async def send(self, message: Message, body: bytes) -> None:
        self.stage_message(message, body)
        await self.commit()

    def stage_message(self, message: Message, body: bytes) -> None:
        """Number a message, to be sent with the next `release`."""
        key = str(getattr(message, self.topic.key)) if self.topic.key else ""
        header = encode_link(Header(self._source, self._epoch, self._seq, message.stamp_ns, key))
        held = UnackedMessage(self._seq, header, body)
        self._unsent.append(held)
        if self._consumers:
            self._unhandled.append(held)
        self._note_state(message, header, body)
        self._seq += 1

    async def commit(self) -> None:
        """Send what is held."""
        while self._unsent:
            if not self.port.is_nonblocking:
                await self._wait_for_room()
            held = self._unsent.popleft()
            self.sent += 1
            self._sent_at_s = self._loop.time()
            await self._publisher.send(held.header, held.body)

    def rollback(self) -> None:
        """What is held was never made: its numbers are given again."""
        self._seq = self._next
        self._unhandled = deque(sent for sent in self._unhandled if sent.seq < self._seq)
        self._unsent.clear()

    @property
    def _next(self) -> int:
        """Number of the first message that was not sent."""
        return self._unsent[0].seq if self._unsent else self._seq

    async def _wait_for_room(self) -> None:
        self.waited += self._consumers.room(self._next) == 0
        while self._consumers.room(self._next) == 0:
            await self._change()

    async def flush(self) -> None:
        """Wait until all that was sent has arrived at every lossless consumer."""
        self._post_welcomes()  # each answers with a grant at once
        while not self._consumers.all_received(self._seq):
            await self._change()

    async def _change(self) -> None:
        self._changed.clear()
        await self._changed.wait()

    def _note_state(self, message: Message, header: bytes, body: bytes) -> None:
        if self.topic.is_state:
            if getattr(message, "part", 0) == 0:
                self._parts.clear()
            self._parts.append((header, body))
            if len(self._parts) == getattr(message, "parts", 1):
                self._last_value = tuple(self._parts)

    def position(self) -> OutletPosition | None:
        """What a successor needs to go on; None where nobody is expected."""
        if not self._consumers.expected:
            return None
        return OutletPosition(self._epoch, self._seq, tuple(self._unhandled))

    # --- consumers --------------------------------------------------------------------------
    def _requested(self, _header: bytes, body: memoryview) -> None:
        """On any thread: grants are few, the loop does the rest."""
        try:
            request = decode_request(body)
        except msgspec.DecodeError as error:
            log.warning("%s: unreadable grant: %s", self.topic.name, error)
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
        self._consumers.join(name, self._seq)
        self._post_welcomes()

    def reset(self, epoch: int) -> None:
        """Number from 0 again: what was sent is forgotten, and every consumer joins anew."""
        if self._repeating is not None:
            self._repeating.cancel()
        self._epoch, self._seq = epoch, 0
        self._consumers = Consumers(self._consumers.expected)
        for forgotten in (self._unhandled, self._unsent, self._parts, self._ahead):
            forgotten.clear()
        self._last_value = ()
        self._post_welcomes()

    def _post_welcomes(self) -> None:
        self._welcomes.post(
            b"", encode_link(ProducerHello(self._epoch, self._consumers.next_seq_by_consumer()))
        )

    def _granted(self, grant: Credit) -> None:
        if grant.arrived > self._seq:
            self._warn_stale_state(grant)
            return
        consumer = self._consumers.grant(grant)
        self._forget_handled()
        if consumer.arrived < self._next:
            self._retransmit(consumer, grant.gap)
        self._changed.set()

    def _warn_stale_state(self, grant: Credit) -> None:
        """It has had messages that were never sent."""
        if grant.consumer not in self._ahead:
            log.error(
                "%s: %s has had %d messages, and %d were made: its state is newer than that of %s, "
                "and nothing is sent to it. Bring both back from one copy, or begin anew with `ldo "
                "control reset`.",
                self.topic.name, grant.consumer, grant.arrived, self._seq, self._source,
            )  # fmt: skip
        self._ahead.add(grant.consumer)

    def _forget_handled(self) -> None:
        oldest = self._consumers.handled(self._seq)
        while self._unhandled and self._unhandled[0].seq < oldest:
            self._unhandled.popleft()

    def _retransmit(self, consumer: Consumer, gap: bool) -> None:
        """Send again what did not arrive: after a gap at once, a lost tail after a while."""
        now = self._loop.time()
        recently = now - consumer.repeated_at_s < self.REPEAT_AFTER_S
        if gap:
            is_on_its_way = recently and consumer.repeated_from == consumer.arrived
        else:
            is_on_its_way = recently or now - self._sent_at_s < self.REPEAT_AFTER_S
        if is_on_its_way or self._repeating is not None:
            return
        consumer.repeated_from, consumer.repeated_at_s = consumer.arrived, now
        lost = [sent for sent in self._unhandled if consumer.arrived <= sent.seq < self._next]
        self.repeated += len(lost)
        self._repeating = self._loop.create_task(self._send_again(lost))

    async def _send_again(self, lost: list[UnackedMessage]) -> None:
        try:
            for sent in lost:
                await self._again.send(sent.header, sent.body)
        finally:
            self._repeating = None

    def _presence(self, name: str, alive: bool) -> None:
        if not alive and not self._closed and name in self._consumers:
            log.warning("%s: consumer %s is gone", self.topic.name, name)
            self._consumers.leave(name)
            self._forget_handled()
            self._changed.set()

    def evict_stalled(self) -> None:
        """Evict consumers that live and yet take nothing; called with every heartbeat."""
        overdue = self._consumers.stalled(self._loop.time(), self._evict_after_s, self._next)
        for name in overdue:
            log.error("%s: consumer %s took nothing for %.0f s and is evicted",
                      self.topic.name, name, self._evict_after_s)  # fmt: skip
            self.evicted += 1
            self._consumers.evict(name)
            self._forget_handled()
            self._changed.set()
            self._on_evicted(name)

    # --- the rest ---------------------------------------------------------------------------
    def counts(self) -> OutputCount:
        return OutputCount(
            topic=self.topic.name,
            sent=self.sent,
            backpressure_waits=self.waited,
            evicted_consumers=self.evicted,
            retransmitted=self.repeated,
        )

    def close(self) -> None:
        self._closed = True
        if self._repeating is not None:
            self._repeating.cancel()
        for publisher in (self._publisher, self._again, self._welcomes):
            publisher.close()


class Outlets:
    """What a step made is held by each, released when the step is saved, or taken back."""

    def __init__(self, outlets: Iterable[Outlet] = ()) -> None:
        self._all = {outlet.topic.message: outlet for outlet in outlets}

    def __getitem__(self, message: type[Message]) -> Outlet:
        return self._all[message]

    @property
    def is_nonblocking(self) -> bool:
        """Whether one of them is of a port that never waits."""
        return any(outlet.port.is_nonblocking for outlet in self._all.values())

    @property
    def has_required_consumers(self) -> bool:
        """Whether some consumer must not miss a message."""
        return any(outlet.position() for outlet in self._all.values())

    def room(self) -> dict[Topic, int]:
        """Of the ports that never wait, whose actor looks before it makes something."""
        return {
            outlet.topic: outlet.credits()
            for outlet in self._all.values()
            if outlet.port.is_nonblocking
        }

    def past(self) -> dict[str, OutletPosition | None]:
        return {outlet.topic.name: outlet.position() for outlet in self._all.values()}

    def hold(self, produced: Sequence[Produced]) -> None:
        for out in produced:
            self._all[type(out.message)].stage_message(out.message, out.body)

    async def release(self, *, is_saved: bool = True) -> None:
        """Send what is held; of a step that is not saved what nobody has to get."""
        for outlet in self._all.values():
            if is_saved or outlet.position() is None:
                await outlet.commit()

    def take_back(self) -> None:
        for outlet in self._all.values():
            outlet.rollback()

    async def flush(self) -> None:
        for outlet in self._all.values():
            await outlet.flush()

    def renew(self, epoch: int) -> None:
        for outlet in self._all.values():
            outlet.reset(epoch)

    def check_windows(self) -> None:
        for outlet in self._all.values():
            outlet.evict_stalled()

    def counts(self) -> tuple[OutputCount, ...]:
        return tuple(outlet.counts() for outlet in self._all.values())

    def close(self) -> None:
        for outlet in self._all.values():
            outlet.close()
