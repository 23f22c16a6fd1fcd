"""All inputs of one actor, merged in order of arrival, bounded, every drop counted."""

import asyncio
import logging
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from threading import Lock

from ldo_service.schemas import InputCount

from .links import (
    Grant,
    Header,
    Join,
    data_key,
    decode_header,
    decode_welcome,
    encode,
    grant_key,
    welcome_key,
)
from .ports import In, Latest, Lossless
from .transport import Publisher, Transport

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """One message, as it arrived."""

    port: In
    header: Header
    body: memoryview


@dataclass
class Inlet:
    """One input: what waits, and what was counted."""

    port: In
    waiting: deque[Delivery] = field(default_factory=deque)
    delivered: int = 0
    dropped: int = 0
    rejected: int = 0
    gaps: int = 0
    peak: int = 0

    def offer(self, delivery: Delivery) -> list[Delivery]:
        """Take a delivery in; what had to make room for it."""
        self.waiting.append(delivery)
        evicted = self._overflow(delivery)
        for old in evicted:
            self.waiting.remove(old)
        self.dropped += len(evicted)
        self.peak = max(self.peak, len(self.waiting))
        return evicted

    def _overflow(self, delivery: Delivery) -> list[Delivery]:
        policy = self.port.policy
        if isinstance(policy, Lossless):
            return []  # the producer keeps to the window
        if not policy.per_key:
            return [self.waiting[0]] if len(self.waiting) > policy.keep else []
        by_key: OrderedDict[str, list[Delivery]] = OrderedDict()
        for waiting in self.waiting:
            by_key.setdefault(waiting.header.key, []).append(waiting)
        same = by_key[delivery.header.key]
        if len(same) > policy.keep:
            return same[:1]
        return by_key.popitem(last=False)[1] if len(by_key) > policy.max_keys else []

    def statistics(self) -> InputCount:
        return InputCount(
            topic=self.port.topic.name,
            delivered=self.delivered,
            dropped=self.dropped,
            rejected=self.rejected,
            gaps=self.gaps,
            waiting=len(self.waiting),
            peak=self.peak,
        )


@dataclass
class LosslessInlet(Inlet):
    """The consumer's end of a link: order, gaps and grants."""

    epoch: int = 0  # of the producer that welcomed us; 0 before
    handled: int = 0
    arrived: int = 0
    gap: bool = False

    def welcome(self, epoch: int, start: int) -> None:
        if epoch != self.epoch:
            self.epoch, self.handled, self.arrived = epoch, start, start
            self.gap = True  # ask for what was sent before we were known

    def accept(self, header: Header) -> bool:
        """Whether this is the next message; anything else is a repetition or shows a gap."""
        assert isinstance(self.port.policy, Lossless)
        if header.epoch != self.epoch or header.seq < self.arrived:
            return False
        self.gap = header.seq > self.arrived
        if self.gap or header.seq >= self.handled + self.port.policy.window:
            self.gaps += 1
            return False
        self.arrived += 1
        return True

    def grant(self, consumer: str) -> Join | Grant:
        assert isinstance(self.port.policy, Lossless)
        if self.epoch == 0:
            return Join(consumer)
        limit = self.handled + self.port.policy.window
        return Grant(consumer, self.epoch, self.handled, self.arrived, limit, self.gap)


class Mailbox:
    """Offered to on any thread, taken from on the event loop.

    A delivery counts as handled when `done` is called: a consumer that dies before gets it again.
    """

    def __init__(self, consumer: str, ports: tuple[In, ...], transport: Transport) -> None:
        self._consumer = consumer
        self._loop = asyncio.get_running_loop()
        self._lock = Lock()
        self._order: deque[Delivery] = deque()
        self._ready = asyncio.Event()
        self._wake_pending = False
        self._closed = False
        self._grants: dict[str, Publisher] = {}
        self._inlets: dict[str, Inlet] = {}
        for port in ports:
            self._connect(port, transport)
        self.send_grants()

    def _connect(self, port: In, transport: Transport) -> None:
        topic = port.topic.name
        if isinstance(port.policy, Latest):
            inlet = Inlet(port)
        else:
            inlet = LosslessInlet(port)
            self._grants[topic] = transport.publisher(grant_key(topic))
            transport.subscribe(
                welcome_key(topic), lambda _header, body: self._welcomed(inlet, body)
            )
        self._inlets[topic] = inlet
        transport.subscribe(
            data_key(topic), lambda header, body: self._arrived(inlet, header, body)
        )

    # --- arriving, on any thread --------------------------------------------------------------
    def _arrived(self, inlet: Inlet, raw_header: bytes, body: memoryview) -> None:
        with self._lock:
            if self._closed:
                return
            try:
                header = decode_header(raw_header)
            except Exception:
                inlet.rejected += 1
                return
            if isinstance(inlet, LosslessInlet) and not inlet.accept(header):
                self._wake(grant=True)
                return
            delivery = Delivery(inlet.port, header, body)
            for dropped in inlet.offer(delivery):
                self._order.remove(dropped)
            self._order.append(delivery)
            self._wake()

    def _welcomed(self, inlet: LosslessInlet, body: memoryview) -> None:
        welcome = decode_welcome(body)
        if welcome.consumer == self._consumer:
            with self._lock:
                inlet.welcome(welcome.epoch, welcome.start)
                self._wake(grant=True)

    def _wake(self, grant: bool = False) -> None:
        """Under the lock: one wake-up pending is enough, however many messages come."""
        if grant:
            self._loop.call_soon_threadsafe(self.send_grants)
        elif not self._wake_pending:
            self._wake_pending = True
            self._loop.call_soon_threadsafe(self._ready.set)

    # --- taking, on the event loop --------------------------------------------------------------
    async def take(self) -> Delivery | None:
        """The oldest delivery; None when the mailbox was closed and is empty."""
        while True:
            with self._lock:
                self._wake_pending = False
                self._ready.clear()
                if self._order:
                    delivery = self._order.popleft()
                    self._inlets[delivery.port.topic.name].waiting.popleft()
                    return delivery
                if self._closed:
                    return None
            await self._ready.wait()

    def done(self, delivery: Delivery, rejected: bool = False) -> None:
        """The delivery was handled, or cannot be: either way it will not come again."""
        inlet = self._inlets[delivery.port.topic.name]
        with self._lock:
            inlet.delivered += not rejected
            inlet.rejected += rejected
            if isinstance(inlet, LosslessInlet) and inlet.epoch == delivery.header.epoch:
                inlet.handled = delivery.header.seq + 1
        if isinstance(inlet, LosslessInlet):
            self._send_grant(inlet)

    def send_grants(self) -> None:
        """Repeat every grant: lost ones heal, new producers learn of us."""
        for inlet in self._inlets.values():
            if isinstance(inlet, LosslessInlet):
                self._send_grant(inlet)

    def _send_grant(self, inlet: LosslessInlet) -> None:
        with self._lock:
            grant, inlet.gap = inlet.grant(self._consumer), False
        self._grants[inlet.port.topic.name].post(b"", encode(grant))

    def close(self) -> None:
        """Take nothing more in; what waits can still be taken."""
        with self._lock:
            self._closed = True
        self._ready.set()

    def release(self) -> None:
        for publisher in self._grants.values():
            publisher.close()

    def statistics(self) -> tuple[InputCount, ...]:
        with self._lock:
            return tuple(inlet.statistics() for inlet in self._inlets.values())
