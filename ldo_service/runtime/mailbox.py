"""All inputs of one actor, merged in order of arrival but for those that go first, bounded, every
drop counted."""

import asyncio
import logging
from collections import deque
from collections.abc import Mapping
from threading import Lock

import msgspec

from ldo_service.schemas import InputCount, decode
from ldo_service.schemas.topics import Topic
from ldo_service.transport.flow_control import (
    EXTERNAL_HEADER,
    Header,
    InletPosition,
    ProducerHello,
    credit_key,
    data_key,
    encode_link,
    producer_hello_key,
    retransmit_key,
)
from ldo_service.transport.interface import Publisher, Transport, call_soon

from .actor import In, Lossless
from .inlet import Delivery, Inlet, LosslessInlet
from .stage_commands import StageCommand

log = logging.getLogger(__name__)


class Mailbox:
    """Offered to on any thread, taken from on the event loop.

    A delivery counts as handled when `done` is called: a consumer that dies before gets it again.
    """

    def __init__(
        self,
        consumer: str,
        ports: tuple[In, ...],
        transport: Transport,
        max_bytes: int = 64_000_000,  # of a Latest input: lossless ones come from our own actors
        past: Mapping[str, InletPosition]
        | None = None,  # by lossless topic: where a predecessor was
    ) -> None:
        self._consumer, self._max_bytes = consumer, max_bytes
        self._loop = asyncio.get_running_loop()
        self._lock = Lock()  # of everything below that both sides use
        self._order: deque[Delivery] = deque()
        self._ready = asyncio.Event()
        self._wake_pending = self._grant_pending = False
        self._closed = self._held = False
        self.waits_for_disk = False  # then it takes nothing, and that is no fault of this process
        self._orders: deque[StageCommand] = deque()
        self._grants: dict[str, Publisher] = {}
        self._inlets: dict[str, Inlet] = {}
        for port in ports:
            self._connect(port, transport, (past or {}).get(port.topic.name))
        self.send_credits()

    def _connect(self, port: In, transport: Transport, past: InletPosition | None) -> None:
        topic = port.topic.name
        inlet = LosslessInlet(port) if isinstance(port.policy, Lossless) else Inlet(port)
        self._inlets[topic] = inlet

        def arrived(header: bytes, body: memoryview) -> None:
            self._arrived(inlet, header, body)

        if isinstance(inlet, LosslessInlet):
            link = inlet
            if past is not None:
                link.resume_from(past)
            self._grants[topic] = transport.publisher(credit_key(topic))
            transport.subscribe(
                producer_hello_key(topic), lambda _, body: self._welcomed(link, body)
            )
            transport.subscribe(retransmit_key(topic), arrived)
        transport.subscribe(data_key(topic), arrived)

    # --- arriving, on any thread --------------------------------------------------------------
    def _arrived(self, inlet: Inlet, raw_header: bytes, body: memoryview) -> None:
        header = _read_header(raw_header)
        with self._lock:
            if self._closed:
                return
            if header is not None and not isinstance(inlet, LosslessInlet):
                inlet.number(header)
            if self._held and not isinstance(inlet, LosslessInlet):
                inlet.paused += 1
            elif header is None:
                self._reject(inlet, "its header cannot be read")
            elif body.nbytes > self._max_bytes and not isinstance(inlet, LosslessInlet):
                limit = "service.max_decoded_message_mb"
                self._reject(inlet, f"{body.nbytes} bytes are more than {limit}")
            elif inlet.accept(header):
                self._store(inlet, Delivery(inlet.port, header, body))
            else:
                self._ask_for_grants()

    def _reject(self, inlet: Inlet, why: str) -> None:
        """Before anything is decoded. Under the lock."""
        if inlet.rejected == 0:
            log.warning("%s: %s rejected: %s. Those that follow are counted.",
                        self._consumer, inlet.port.topic.name, why)  # fmt: skip
        inlet.rejected += 1

    def _store(self, inlet: Inlet, delivery: Delivery) -> None:
        for displaced in inlet.offer(delivery):
            self._order.remove(displaced)
        self._order.append(delivery)
        if not self._wake_pending:  # one wake-up is enough, however many messages come
            self._wake_pending = True
            call_soon(self._loop, self._ready.set)

    def _welcomed(self, inlet: LosslessInlet, body: memoryview) -> None:
        try:
            welcome = decode(body, ProducerHello)
        except msgspec.DecodeError as error:
            log.warning("%s: unreadable welcome: %s", inlet.port.topic.name, error)
            return
        start = welcome.starts.get(self._consumer)
        with self._lock:
            lost = 0 if start is None else inlet.welcome(welcome.epoch, start)
            self._ask_for_grants()
        if lost:
            log.error("%s: %d messages of %s were missed: it was evicted",
                      self._consumer, lost, inlet.port.topic.name)  # fmt: skip

    def _ask_for_grants(self) -> None:
        """Under the lock."""
        if not self._grant_pending:
            self._grant_pending = True
            call_soon(self._loop, self.send_credits)

    # --- taking, on the event loop --------------------------------------------------------------
    async def take(self) -> Delivery | StageCommand | None:
        """An order, else the oldest delivery, of an input that goes first if there is one; None
        when the mailbox was closed and is empty."""
        while True:
            with self._lock:
                self._wake_pending = False
                self._ready.clear()
                if self._orders:
                    return self._orders.popleft()
                if self._order and not self._held:
                    delivery = next((d for d in self._order if d.port.has_priority), self._order[0])
                    self._order.remove(delivery)
                    self._inlets[delivery.port.topic.name].waiting.popleft()
                    return delivery
                if self._closed:
                    return None
            await self._ready.wait()

    def done(self, delivery: Delivery, rejected: bool = False) -> None:
        """The delivery was handled, or cannot be: either way it will not come again."""
        inlet = self._inlets[delivery.port.topic.name]
        with self._lock:
            inlet.done(delivery, rejected)
        if isinstance(inlet, LosslessInlet):
            self._send_grant(inlet)

    def past(self, being_handled: Delivery | None = None) -> dict[str, InletPosition]:
        """Where a successor goes on, by lossless topic, once that delivery was handled."""
        with self._lock:
            return {
                topic: inlet.position(
                    being_handled if being_handled and being_handled.port is inlet.port else None
                )
                for topic, inlet in self._inlets.items()
                if isinstance(inlet, LosslessInlet)
            }

    def put_command(self, order: StageCommand) -> None:
        """It is taken before any delivery."""
        self._orders.append(order)
        self._ready.set()

    def pause(self) -> None:
        """Give out no deliveries until `resume`; what has a policy of Latest is left out."""
        with self._lock:
            self._held = True
            for inlet in self._inlets.values():
                inlet.discard_backlog()
            self._keep_only_waiting()

    def resume(self) -> None:
        with self._lock:
            self._held = False
        self._ready.set()

    @property
    def is_held(self) -> bool:
        return self._held

    def reset(self) -> None:
        """Forget what waits, and join the producers again."""
        with self._lock:
            for inlet in self._inlets.values():
                inlet.reset()
            self._keep_only_waiting()
        self.send_credits()

    def _keep_only_waiting(self) -> None:
        """Under the lock."""
        waiting = {id(d) for inlet in self._inlets.values() for d in inlet.waiting}
        self._order = deque(d for d in self._order if id(d) in waiting)

    def send_credits(self) -> None:
        """Repeat every grant: lost ones heal, new producers learn of us."""
        with self._lock:
            self._grant_pending = False
        for inlet in self._inlets.values():
            if isinstance(inlet, LosslessInlet):
                self._send_grant(inlet)

    def _send_grant(self, inlet: LosslessInlet) -> None:
        with self._lock:
            grant = inlet.grant(self._consumer, waits_for_disk=self.waits_for_disk)
        self._grants[inlet.port.topic.name].post(b"", encode_link(grant))

    def close(self) -> None:
        """Take nothing more in; what waits can still be taken."""
        with self._lock:
            self._closed, self._held = True, False
        self._ready.set()

    def disconnect(self) -> None:
        for publisher in self._grants.values():
            publisher.close()

    def waiting(self) -> dict[Topic, int]:
        """Messages of each lossless input that were not taken yet."""
        with self._lock:
            return {
                inlet.port.topic: len(inlet.waiting)
                for inlet in self._inlets.values()
                if isinstance(inlet, LosslessInlet)
            }

    def counts(self) -> tuple[InputCount, ...]:
        with self._lock:
            return tuple(inlet.counts() for inlet in self._inlets.values())


def _read_header(raw: bytes) -> Header | None:
    """None when it cannot be read."""
    try:
        return decode(raw, Header) if raw else EXTERNAL_HEADER
    except msgspec.DecodeError:
        return None
