"""Service of simulated processes: the real stages, links, commands and supervision.

Simulated are the processes, the threads of the actors, the network, the disk, and the actors
themselves. `Machine` starts the service again after it has failed, as systemd does.
"""

import asyncio
import fcntl
import os
import random
import secrets
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from ldo_service.errors import ConfigError, DataError
from ldo_service.runtime import process as child_module
from ldo_service.runtime import stage as stage_module
from ldo_service.runtime import stage_metrics
from ldo_service.runtime.actor import Actor
from ldo_service.runtime.actor_graph import (
    consumers_first,
    consumers_with_backlog,
    finish_order,
    lossless_consumers,
)
from ldo_service.runtime.control import Control
from ldo_service.runtime.generations import GenerationKeeper, keep_last
from ldo_service.runtime.process import ChildProcess
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import CommandSender
from ldo_service.runtime.step import Produced, produce
from ldo_service.runtime.supervision import Runner, StopRequest, supervise
from ldo_service.runtime.supervision_policy import SupervisionConfig
from ldo_service.schemas import ControlAnswer, ControlRequest, Message, decode, encode
from ldo_service.service.state_folder import PAUSE_MARKER, RESET_MARKER, claim_state
from ldo_service.storage.state_store import FolderStore

from .actors import GRAPH, NAMES, Observer, SimulatedActor
from .disk import SimulatedDisk
from .network import DRIVER, SimulatedNetwork, SimulatedTransport
from .processes import ChildHandle, NoPipe, SimulatedWorker
from .virtual_loop import CURRENT, Process, VirtualLoop

# Limits that are shorter than the defaults, so that a run reaches them within seconds.
SUPERVISION = SupervisionConfig(evict_after_s=2.0, stall_after_s=5.0, backend_stall_after_s=5.0)
SILENT_AFTER_S = 4.0  # Heartbeat timeout of a child process, seconds; the default is 10.
DRAIN_S = 3.0  # Time of a soft stop, seconds; the default is 10.
CONTROL_TIMEOUT_S = 10.0  # Time of a command, seconds; the default is 55.
START_S = (0.5, 1.5)  # Time from the start of a process until its code runs, seconds.
RESTART_S = 5.0  # Time after which systemd starts a failed service again: RestartSec of the unit.
STEP_S = (0.0005, 0.01)  # Duration of a job in the thread of an actor, seconds.
NEVER_RETRIED = ConfigError.exit_code  # Exit code after which systemd does not start it again.


class Machine:
    """Machine that runs the service.

    Attributes:
        actors: The last instance of each actor, by name.
        failures: Description of each end of the service, with its exit code.
        slow_s: Duration of each job of an actor, by name, while the actor is slow, seconds.
        hang_s: Duration of the next job of an actor, by name, seconds.
        hangs_until_s: Time at which the last hanging job ends, seconds.
        failing: Actors of which the next step fails.
        is_waiting: Whether the service has ended, and systemd waits before its next start.
        failing_after_save: Actors of which the next save is followed by an error.
        on_lost_state: Called when the disk has lost states that were saved.
    """

    def __init__(
        self,
        loop: VirtualLoop,
        seed: int,
        violation: Callable[[str], None],
        observe: Callable[[str, bytes, bytes], None],
        remote: Collection[str] = (),
    ) -> None:
        """Create a machine with an empty disk; `run` starts the service.

        Args:
            loop: The event loop of all processes.
            seed: Seed of the layout of processes, of durations and of all random numbers.
            violation: Called with the description of a violated invariant.
            observe: Called with key, header and body of each message when it is sent.
            remote: Names of the actors that run on another host, each in its own process.
        """
        self.loop, self.rng = loop, random.Random(f"{seed} machine")
        self.violation = violation
        self.remote = tuple(name for name in NAMES if name in remote)
        self.disk = SimulatedDisk(seed)
        self.network = SimulatedNetwork(loop, seed, observe, self.remote)
        self.syncs = self.rng.random() < 1 / 3  # The setting `service.fsync`.
        layouts = (("optimizer",), ("optimizer",), (), NAMES, ("mapper", "optimizer"))
        self.children = tuple(n for n in self.rng.choice(layouts) if n not in self.remote)
        self.actors: dict[str, SimulatedActor] = {}
        self.processes: dict[str, Process] = {}  # The last process of each name.
        self.failures: list[str] = []
        self.slow_s: dict[str, float] = {}
        self.hang_s: dict[str, float] = {}
        self.hangs_until_s = 0.0
        self.failing: set[str] = set()
        self.failing_after_save: set[str] = set()
        self.on_lost_state: Callable[[], None] = lambda: None
        self.control: Control | None = None  # Control interface of the running service.
        self._observer = Observer(violation, self._fail_after_save)
        self._stop: StopRequest | None = None
        self._failed_actors: set[str] = set()
        self._is_off = self.is_waiting = False

    # --- life of the service --------------------------------------------------------------------
    async def run(self) -> None:
        """Start the service, again and again."""
        for name in self.remote:
            process = self.processes[name] = Process(self.loop, name)
            process.start(self._serve_actor(name, StopRequest()))
        while True:
            process = Process(self.loop, "service")
            self.processes["service"] = process
            process.on_end.append(self._service_ended)
            process.start(self._serve())
            await process.ended.wait()
            self.failures.append(f"{self.loop.time():.3f} exit code {process.exit_code}")
            if process.exit_code == NEVER_RETRIED:
                self.violation("the service ended with an exit code that systemd does not retry")
            # The next start completes an interrupted reset, which may leave states in part.
            is_reset = (self.disk.path / RESET_MARKER).exists()
            if process.exit_code == DataError.exit_code and not is_reset:
                self.violation("the service found no undamaged state")
            self.is_waiting = True
            await asyncio.sleep(RESTART_S if process.exit_code else 0.0)
            while self._is_off:
                await asyncio.sleep(0.1)
            self.is_waiting = False

    def _service_ended(self) -> None:
        self.control = self._stop = None
        for name in self.children:
            if child := self.processes.get(name):
                self.loop.call_later(self.rng.uniform(0.0, 0.5), child.kill, context=DRIVER)

    def stop(self) -> None:
        """Request a soft stop of the service, which then starts again."""
        if self._stop:
            self._stop.request()

    def cut_power(self, off_s: float) -> None:
        """Kill all processes, and lose what the disk has not synced.

        Args:
            off_s: Time until the machine has started again, seconds.
        """
        self._is_off = True
        for process in self.processes.values():
            process.kill()
        self.disk.cut_power()
        if not self.syncs:
            self.on_lost_state()
        self.loop.call_later(off_s, setattr, self, "_is_off", False)

    async def command(self, verb: str) -> ControlAnswer | None:
        """Execute a command of a client; None if the service ends meanwhile."""
        process, control = self.processes["service"], self.control
        if control is None or process.is_dead:
            return None
        request = encode(ControlRequest(stamp_ns=0, command=verb))
        task = self.loop.create_task(control.answer(request), context=process.context)
        await asyncio.wait({task})
        if task.cancelled() or process.is_dead:
            return None
        return decode(task.result(), ControlAnswer)

    # --- processes ------------------------------------------------------------------------------
    async def _serve(self) -> None:
        """Do what the main process of the service does; see `Service`."""
        await asyncio.sleep(self.rng.uniform(*START_S))
        with ExitStack() as stack:
            claim_state(self.disk.path, stack, self.remote)
            transport = self.network.transport("service")
            suspects, children = asyncio.Lock(), dict[str, ChildProcess]()
            runners: list[Runner] = []
            local = [actor for actor in finish_order(GRAPH) if actor.name not in self.remote]
            names = [name for name in NAMES if name not in self.remote]
            for actor in local:
                if actor.name in self.children:
                    children[actor.name] = self._child(actor.name, transport)
                    runners.append(children[actor.name])
                else:
                    runners.append(self._stage(actor, transport, suspects, children))
            store = FolderStore(self.disk.path / "state")
            kept = [a.name for a in consumers_first(GRAPH) if a.name not in self.remote]
            keeper = GenerationKeeper(CommandSender(transport), store, kept)
            keeping = asyncio.create_task(keeper.run())
            self.control = Control(
                transport,
                actors=NAMES,
                sources=("frame_source", "tracker"),
                saved_where="",
                timeout_s=CONTROL_TIMEOUT_S,
                reset_marker=self.disk.path / RESET_MARKER,
                pause_marker=self.disk.path / PAUSE_MARKER,
                generations=keeper,
            )
            self._stop = StopRequest()
            try:
                await supervise(runners, self._stop, DRAIN_S, 2)
            finally:
                keeping.cancel()
                transport.close()
            try:
                keep_last(store, names)
            except (OSError, DataError):
                if not self.disk.is_full and not self.disk.error_probability:
                    raise

    def _stage(
        self,
        kind: type[SimulatedActor],
        transport: SimulatedTransport,
        suspects: asyncio.Lock,
        children: dict[str, ChildProcess],
    ) -> Stage:
        def make() -> Actor:
            actor = self.actors[kind.name] = kind(self._observer)
            return actor

        def evicted(consumer: str) -> None:
            if consumer in children:
                children[consumer].kill()

        topics = [out.topic.name for out in kind.outputs]
        is_remote = kind.name in self.remote
        folder = self.disk.path / ("remote" if is_remote else "state")
        is_source = kind.name in ("frame_source", "tracker")
        markers = [self.disk.path / m for m in (RESET_MARKER, *([PAUSE_MARKER] * is_source))]
        return Stage(
            make,
            transport,
            config=SUPERVISION,
            store=FolderStore(folder, syncs=self.syncs or is_remote, has_generations=not is_remote),
            expected={topic: lossless_consumers(GRAPH, topic) for topic in topics},
            with_backlog={topic: consumers_with_backlog(GRAPH, topic) for topic in topics},
            on_evicted=evicted,
            suspects=suspects,
            starts_paused=lambda: any(marker.exists() for marker in markers),
        )

    def _child(self, name: str, transport: SimulatedTransport) -> ChildProcess:
        return ChildProcess(
            name,
            [name],
            transport,
            environment={},
            max_restarts=SUPERVISION.max_restarts,
            restart_window_s=SUPERVISION.restart_window_s,
            restart_delay_s=SUPERVISION.restart_delay_s,
            silent_after_s=SILENT_AFTER_S,
            step_timeout_s=SUPERVISION.stall_after_s,
        )

    async def spawn(self, name: str, **_options: Any) -> "ChildHandle":
        """Start the child process of an actor, instead of `asyncio.create_subprocess_exec`."""
        process = self.processes[name] = Process(self.loop, name)
        stop = StopRequest()
        process.start(self._serve_actor(name, stop))
        return ChildHandle(process, stop)

    async def _serve_actor(self, name: str, stop: StopRequest) -> None:
        """Do what the child process of an actor does, or the process of a remote actor."""
        await asyncio.sleep(self.rng.uniform(*START_S))
        (kind,) = (kind for kind in GRAPH if kind.name == name)
        transport = self.network.transport(name)
        stage = self._stage(kind, transport, asyncio.Lock(), {})
        try:
            await supervise([stage], stop, DRAIN_S)
        finally:
            transport.close()

    # --- injected faults ------------------------------------------------------------------------
    def duration_s(self, actor: str) -> float:
        """Return the duration of the next job in the thread of an actor, seconds."""
        if actor in self.hang_s:
            self.hangs_until_s = self.loop.time() + self.hang_s[actor]
            return self.hang_s.pop(actor)
        return self.slow_s.get(actor, 0.0) + self.rng.uniform(*STEP_S)

    def produce(self, actor: Actor, messages: Iterable[Message]) -> list[Produced]:
        """Run a step as `step.produce` does, and fail if the actor has to.

        An actor fails only once until a step of it is saved, because a message whose second
        delivery fails too is discarded by design.
        """
        produced = produce(actor, messages)
        if actor.name in self.failing and actor.name not in self._failed_actors:
            self.failing.discard(actor.name)
            self._failed_actors.add(actor.name)
            raise RuntimeError("injected")
        return produced

    def _fail_after_save(self, actor: str) -> None:
        self._failed_actors.discard(actor)
        if actor in self.failing_after_save:
            self.failing_after_save.discard(actor)
            raise RuntimeError("injected failure after the save")

    @contextmanager
    def running(self) -> Iterator[None]:
        """Replace clocks, random numbers, threads and processes in the block."""
        pid = os.getpid()

        def getpid() -> int:
            process = CURRENT.get()
            return process.pid if process else pid

        def is_suspended(pid: int) -> bool:
            return any(p.pid == pid and p.is_frozen for p in self.processes.values())

        def worker(name: str, **_options: Any) -> SimulatedWorker:
            return SimulatedWorker(self.loop, lambda: self.duration_s(name))

        with (
            self.disk.mounted(),
            patch.object(time, "monotonic", self.loop.time),
            patch.object(secrets, "randbits", self.rng.getrandbits),
            patch.object(os, "getpid", getpid),
            patch.object(fcntl, "flock", lambda *_: None),
            patch.object(asyncio, "create_subprocess_exec", self.spawn),
            patch.object(child_module, "HeartbeatPipe", NoPipe),
            patch.object(child_module, "_is_suspended", is_suspended),
            patch.object(stage_module, "Worker", worker),
            patch.object(stage_module, "produce", self.produce),
            patch.object(stage_metrics, "resident_mb", lambda: 0.0),
            patch.object(stage_metrics, "available_memory_mb", lambda: None),
            patch.object(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e12)),
        ):
            yield
