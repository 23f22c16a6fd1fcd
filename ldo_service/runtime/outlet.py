"""Sending half of a topic."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ldo_service.schemas import Message, OutputCount
from ldo_service.schemas.topics import Topic

from .actor import UNLIMITED
from .links import (
    Grant,
    Header,
    Join,
    Welcome,
    data_key,
    decode_request,
    encode,
    grant_key,
    welcome_key,
)
from .transport import Transport

log = logging.getLogger(__name__)


@dataclass
class Consumer:
    """A lossless consumer as the producer knows it."""

    alive: bool = False
    handled: int = 0
    arrived: int = 0
    limit: int = 0
    resent_from: int = -1  # where the last repetition began, and when
    resent_at_s: float = 0.0
    shut_since_s: float | None = None  # when its window was first seen shut


class Outlet:
    """Numbers messages, waits for room at every lossless consumer, sends again what got lost.

    `expected` names consumers that must not miss a message: until each has joined, and again after
    one died, there is no room. Others hold the producer back only while they live.
    """

    RESEND_AFTER_S = 0.25  # half a grant period: sooner would repeat what is still on its way

    def __init__(
        self,
        topic: Topic,
        source: str,
        epoch: int,
        transport: Transport,
        expected: Iterable[str] = (),
        evict_after_s: float = 30.0,
        on_evicted: Callable[[str], None] = lambda _consumer: None,
    ) -> None:
        self.topic, self._source, self._epoch = topic, source, epoch
        self._evict_after_s, self._on_evicted = evict_after_s, on_evicted
        self._loop = asyncio.get_running_loop()
        self._seq = 0
        self._sent_at_s = self._loop.time()
        self._consumers = {name: Consumer() for name in expected}
        self._expected = frozenset(expected)
        self._unhandled: deque[tuple[int, bytes, bytes]] = deque()  # seq, header, body
        self._last: list[tuple[bytes, bytes]] = []
        self._opened = asyncio.Event()
        self._publisher = transport.publisher(data_key(topic.name))
        self._welcomes = transport.publisher(welcome_key(topic.name))
        self._repeating: set[asyncio.Task[None]] = set()
        self.sent = self.waited = self.evicted = 0
        transport.subscribe(grant_key(topic.name), self._requested)
        transport.watch(self._presence)
        if topic.is_state:
            transport.answer(data_key(topic.name), lambda: tuple(self._last))

    # --- sending ----------------------------------------------------------------------------
    def room(self) -> int:
        """How many messages may be sent now without waiting."""
        limits = [c.limit - self._seq if c.alive else 0 for c in self._consumers.values()]
        return min(limits, default=UNLIMITED)

    async def send(self, message: Message, body: bytes) -> None:
        await self._wait_for_room()
        key = str(getattr(message, self.topic.key)) if self.topic.key else ""
        header = encode(Header(self._source, self._epoch, self._seq, message.stamp_ns, key))
        self._keep(message, header, body)
        self._seq += 1
        self.sent += 1
        self._sent_at_s = self._loop.time()
        await self._publisher.send(header, body)

    async def _wait_for_room(self) -> None:
        if self.room() > 0:
            return
        self.waited += 1
        while self.room() <= 0:
            self._opened.clear()
            await self._opened.wait()

    def _keep(self, message: Message, header: bytes, body: bytes) -> None:
        if self._consumers:
            self._unhandled.append((self._seq, header, body))
        if self.topic.is_state:
            if getattr(message, "part", 0) == 0:
                self._last.clear()
            self._last.append((header, body))

    # --- consumers --------------------------------------------------------------------------
    def _requested(self, _header: bytes, body: memoryview) -> None:
        """On any thread: grants are few, the loop does the rest."""
        try:
            request = decode_request(body)
        except Exception as error:
            log.warning("%s: unreadable grant: %s", self.topic.name, error)
            return
        self._loop.call_soon_threadsafe(self._take_request, request)

    def _take_request(self, request: Join | Grant) -> None:
        if isinstance(request, Join) or request.epoch != self._epoch:
            self._welcome(request.consumer)
        elif request.consumer in self._consumers:
            self._granted(self._consumers[request.consumer], request)

    def _welcome(self, name: str) -> None:
        """A consumer joined, or joined again: it gets what it has not handled."""
        consumer = self._consumers.setdefault(name, Consumer(handled=self._seq))
        start = consumer.handled
        consumer.alive, consumer.arrived, consumer.limit = True, start, start
        consumer.resent_from = -1
        self._welcomes.post(b"", encode(Welcome(name, self._epoch, start)))

    def _granted(self, consumer: Consumer, grant: Grant) -> None:
        consumer.alive = True
        consumer.handled = max(consumer.handled, grant.handled)
        consumer.arrived = max(consumer.arrived, grant.arrived)
        if grant.limit > consumer.limit:
            consumer.limit, consumer.shut_since_s = grant.limit, None
        self._forget_handled()
        if consumer.arrived < self._seq:
            self._repeat(consumer, grant.gap)
        self._opened.set()

    def _forget_handled(self) -> None:
        oldest = min((c.handled for c in self._consumers.values()), default=self._seq)
        while self._unhandled and self._unhandled[0][0] < oldest:
            self._unhandled.popleft()

    def _repeat(self, consumer: Consumer, gap: bool) -> None:
        """Send again what did not arrive: after a gap at once, a lost tail after a while."""
        now = self._loop.time()
        tail_lost = now - self._sent_at_s > self.RESEND_AFTER_S
        fresh = now - consumer.resent_at_s < self.RESEND_AFTER_S
        if not (gap or tail_lost) or (consumer.resent_from == consumer.arrived and fresh):
            return
        consumer.resent_from, consumer.resent_at_s = consumer.arrived, now
        lost = [(h, b) for seq, h, b in self._unhandled if seq >= consumer.arrived]
        task = self._loop.create_task(self._send_all(lost))
        self._repeating.add(task)
        task.add_done_callback(self._repeating.discard)

    async def _send_all(self, messages: list[tuple[bytes, bytes]]) -> None:
        for header, body in messages:
            await self._publisher.send(header, body)

    def _presence(self, name: str, alive: bool) -> None:
        consumer = self._consumers.get(name)
        if consumer is None or alive:
            return
        consumer.alive = False
        if name not in self._expected:
            del self._consumers[name]
            self._forget_handled()
        log.warning("%s: consumer %s is gone", self.topic.name, name)
        self._opened.set()

    def check_windows(self) -> None:
        """Evict consumers that live and yet take nothing; called with every heartbeat."""
        now = self._loop.time()
        for name, consumer in list(self._consumers.items()):
            if consumer.alive and consumer.limit <= self._seq:
                consumer.shut_since_s = consumer.shut_since_s or now
                if now - consumer.shut_since_s > self._evict_after_s:
                    self._evict(name, consumer)

    def _evict(self, name: str, consumer: Consumer) -> None:
        log.error(
            "%s: consumer %s took nothing for %.0f s and is evicted",
            self.topic.name,
            name,
            self._evict_after_s,
        )
        self.evicted += 1
        consumer.alive, consumer.shut_since_s = False, None
        if name not in self._expected:
            del self._consumers[name]
        self._on_evicted(name)
        self._opened.set()

    # --- the rest ---------------------------------------------------------------------------
    def statistics(self) -> OutputCount:
        return OutputCount(
            topic=self.topic.name, sent=self.sent, waited=self.waited, evicted=self.evicted
        )

    def close(self) -> None:
        for task in self._repeating:
            task.cancel()
        self._publisher.close()
        self._welcomes.close()
