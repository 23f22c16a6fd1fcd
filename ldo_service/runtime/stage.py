"""Runs one actor: take, handle in its own thread, send in order, acknowledge."""

import asyncio
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np

from ldo_service.errors import ConfigError, RestartsExhausted, StageStalled
from ldo_service.schemas import Health, Message
from ldo_service.schemas.topics import HEALTH

from .actor import Actor
from .links import Header, encode
from .mailbox import Delivery, Mailbox
from .outlet import Outlet
from .process import resident_mb
from .state_store import MemoryStore, StateStore
from .transport import Transport

log = logging.getLogger(__name__)
_encode_message = msgspec.msgpack.Encoder().encode


@dataclass(frozen=True, slots=True)
class StageConfig:
    """How patient the runtime is with an actor."""

    max_restarts: int = 5  # within restart_window_s; more is a fault that a restart does not cure
    restart_window_s: float = 60.0
    restart_delay_s: float = 0.05  # doubled with each failure in the window
    restart_delay_max_s: float = 5.0
    heartbeat_s: float = 0.5  # a stopped process shows within two of these
    stall_after_s: float = 60.0  # 100x the slowest step measured (mapper, 1.5 M Gaussians)
    evict_after_s: float = 30.0  # a consumer that takes nothing for so long holds up the robot

    def __post_init__(self) -> None:
        if self.max_restarts < 0 or self.heartbeat_s <= 0 or self.stall_after_s <= 0:
            raise ConfigError(f"{self}: counts and times must be positive.")


@dataclass(frozen=True, slots=True)
class Produced:
    message: Message
    body: bytes


@dataclass
class Counters:
    steps: int = 0
    failures: int = 0
    restarts: int = 0
    set_aside: int = 0
    step_ms: deque[float] = field(default_factory=lambda: deque(maxlen=200))
    last_stamp_ns: int = 0
    finished_at_s: float = 0.0
    started_at_s: float | None = None  # of the step under way


class Stage:
    """`run` until `drain` or cancelled.

    A failed step is tried once more by a successor that starts from the last state; a message that
    fails twice is set aside and counted. `expected` names, for each output topic, the consumers
    that must not miss a message.
    """

    def __init__(
        self,
        make: Callable[[], Actor],
        transport: Transport,
        *,
        config: StageConfig = StageConfig(),
        store: StateStore | None = None,
        expected: Mapping[str, frozenset[str]] | None = None,
        on_evicted: Callable[[str], None] = lambda _consumer: None,
    ) -> None:
        self._make, self._transport, self._config = make, transport, config
        self._store = store or MemoryStore()
        self._expected = expected or {}
        self._on_evicted = on_evicted
        self._actor = self._successor()
        self.name = self._actor.name
        self._count = Counters()
        self._failed_at_s: deque[float] = deque()
        self._state: Literal["starting", "ready", "busy", "draining"] = "starting"
        self._drain_requested = False
        self._mailbox: Mailbox | None = None
        self._outlets: dict[type[Message], Outlet] = {}

    # --- life -----------------------------------------------------------------------------------
    async def run(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._epoch = time.time_ns()  # a number no earlier run of this stage had
        self._count.finished_at_s = self._loop.time()
        self._open_ports()
        self._transport.announce(self.name)
        worker = ThreadPoolExecutor(1, thread_name_prefix=self.name)
        beat = asyncio.create_task(self._beat(), name=f"{self.name} heartbeat")
        work = asyncio.create_task(self._work(worker), name=f"{self.name} work")
        try:
            done, _ = await asyncio.wait({beat, work}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in (beat, work):
                task.cancel()
            await asyncio.gather(beat, work, return_exceptions=True)
            worker.shutdown(wait=False, cancel_futures=True)
            self._close_ports()

    def drain(self) -> None:
        """Soft stop: handle what has arrived, say the last words, end."""
        self._drain_requested = True
        self._state = "draining"
        if self._mailbox:
            self._mailbox.close()

    def _open_ports(self) -> None:
        self._mailbox = Mailbox(self.name, self._actor.inputs, self._transport)
        for port in self._actor.outputs:
            if port.topic.message is None:
                continue  # declared for a later version: nothing can be sent on it
            self._outlets[port.topic.message] = Outlet(
                port.topic,
                self.name,
                self._epoch,
                self._transport,
                self._expected.get(port.topic.name, ()),
                self._config.evict_after_s,
                self._on_evicted,
            )
        self._health = self._transport.publisher(f"{HEALTH.name}/{self.name}")
        if self._drain_requested:
            self._mailbox.close()

    def _close_ports(self) -> None:
        self._health.close()
        for outlet in self._outlets.values():
            outlet.close()
        if self._mailbox:
            self._mailbox.close()
            self._mailbox.release()

    # --- work -----------------------------------------------------------------------------------
    async def _work(self, worker: ThreadPoolExecutor) -> None:
        assert self._mailbox is not None
        if not self._drain_requested:
            self._state = "ready"
        while delivery := await self._mailbox.take():
            message = self._decode(delivery)
            if message is not None:
                await self._step(worker, message)
            self._mailbox.done(delivery, rejected=message is None)
        for out in await self._loop.run_in_executor(worker, self._last_words):
            await self._send(out)

    def _decode(self, delivery: Delivery) -> Message | None:
        topic = delivery.port.topic
        assert topic.message is not None
        try:
            return msgspec.msgpack.decode(delivery.body, type=topic.message)
        except (msgspec.DecodeError, ValueError) as error:  # ValidationError is a DecodeError
            header: Header = delivery.header
            log.warning(
                "%s: %s #%d from %s rejected: %s",
                self.name, topic.name, header.seq, header.source, error,
            )  # fmt: skip
            return None

    async def _step(self, worker: ThreadPoolExecutor, message: Message) -> None:
        for attempt in (1, 2):
            self._actor.room = {o.topic: o.room() for o in self._outlets.values()}
            self._count.started_at_s = started_s = self._loop.time()
            try:
                produced = await self._loop.run_in_executor(worker, self._handle, message)
            except Exception:
                log.exception("%s failed on %s", self.name, type(message).__name__)
                await self._restart()
                if attempt == 2:
                    self._set_aside(message)
                    return
                continue
            finally:
                self._count.started_at_s = None
            self._count.step_ms.append(1e3 * (self._loop.time() - started_s))
            for out in produced:
                await self._send(out)
            self._store.save(self.name, self._actor.snapshot())
            self._count.steps += 1
            self._count.last_stamp_ns = message.stamp_ns
            self._count.finished_at_s = self._loop.time()
            return

    def _handle(self, message: Message) -> list[Produced]:
        """In the actor's thread."""
        return [Produced(out, _encode_message(out)) for out in self._actor.handle(message)]

    def _last_words(self) -> list[Produced]:
        return [Produced(out, _encode_message(out)) for out in self._actor.finish()]

    async def _send(self, out: Produced) -> None:
        await self._outlets[type(out.message)].send(out.message, out.body)

    # --- failure --------------------------------------------------------------------------------
    def _successor(self) -> Actor:
        actor = self._make()
        state = self._store.load(actor.name)
        if state is not None:
            actor.restore(state)
            log.info("%s goes on from its last state", actor.name)
        return actor

    async def _restart(self) -> None:
        """Wait, longer with each failure, and put a successor in place."""
        self._count.failures += 1
        now = self._loop.time()
        self._failed_at_s.append(now)
        while self._failed_at_s[0] < now - self._config.restart_window_s:
            self._failed_at_s.popleft()
        recent = len(self._failed_at_s)
        if recent > self._config.max_restarts:
            raise RestartsExhausted(self.name, recent, self._config.restart_window_s)
        delay_s = self._config.restart_delay_s * 2 ** (recent - 1)
        await asyncio.sleep(min(delay_s, self._config.restart_delay_max_s))
        self._actor = self._successor()
        self._count.restarts += 1

    def _set_aside(self, message: Message) -> None:
        self._count.set_aside += 1
        log.error(
            "%s: %s of stamp %d failed twice and is set aside",
            self.name, type(message).__name__, message.stamp_ns,
        )  # fmt: skip

    # --- health ---------------------------------------------------------------------------------
    async def _beat(self) -> None:
        assert self._mailbox is not None
        while True:
            self._mailbox.send_grants()
            for outlet in self._outlets.values():
                outlet.check_windows()
            self._health.post(
                encode(Header(self.name, self._epoch, 0, self._count.last_stamp_ns)),
                _encode_message(self.health()),
            )
            self._raise_when_stalled()
            await asyncio.sleep(self._config.heartbeat_s)

    def _raise_when_stalled(self) -> None:
        started_s = self._count.started_at_s
        if started_s is not None and self._loop.time() - started_s > self._config.stall_after_s:
            raise StageStalled(self.name, self._loop.time() - started_s)

    def health(self) -> Health:
        assert self._mailbox is not None
        count, now = self._count, self._loop.time()
        step_ms = np.array(count.step_ms or [0.0])
        is_busy = count.started_at_s is not None
        return Health(
            stamp_ns=count.last_stamp_ns,
            actor=self.name,
            state="busy" if is_busy and self._state == "ready" else self._state,
            pid=os.getpid(),
            epoch=self._epoch,
            steps=count.steps,
            failures=count.failures,
            restarts=count.restarts,
            set_aside=count.set_aside,
            step_age_s=now - count.finished_at_s,
            busy_s=now - count.started_at_s if count.started_at_s is not None else 0.0,
            step_ms_p50=float(np.percentile(step_ms, 50)),
            step_ms_p95=float(np.percentile(step_ms, 95)),
            rss_mb=resident_mb(),
            inputs=self._mailbox.statistics(),
            outputs=tuple(outlet.statistics() for outlet in self._outlets.values()),
            facts=self._actor.facts(),
        )
