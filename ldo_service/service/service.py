"""Live service, which runs every actor in the main process or in a child process.

The main process opens the router that all other processes connect to. It starts and supervises the
child processes. Each child process runs `ldo serve --actor ACTOR` with the same configuration and
state folder.
"""

import asyncio
import json
import logging
import os
import signal
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import zenoh

from ldo_service import kernels, versions
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.topology import GRAPH, ActorSpec, actor_spec
from ldo_service.config import (
    Config,
    actor_parameters,
    config_yaml,
    recording_parameters,
    stage_parameters,
)
from ldo_service.errors import ConfigError, DataError, LdoError
from ldo_service.gaussians.map_builder import FILE_PATTERNS
from ldo_service.kernels.gpu.device import gpu_facts
from ldo_service.recordings.actor_files import ActorFiles
from ldo_service.recordings.recorder import Recorder
from ldo_service.recordings.recording import new_path, prepare_recording
from ldo_service.runtime import check_graph
from ldo_service.runtime.actor_graph import (
    consumers_first,
    consumers_with_backlog,
    finish_order,
    lossless_consumers,
)
from ldo_service.runtime.control import Control
from ldo_service.runtime.generations import GenerationKeeper, keep_last
from ldo_service.runtime.journal import Journal
from ldo_service.runtime.process import (
    ChildProcess,
    exit_with_parent,
    python_command,
    raise_file_limit,
)
from ldo_service.runtime.process_heartbeat import start_heartbeat
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import CommandSender
from ldo_service.runtime.supervision import Runner, StopRequest, Watchdog, supervise
from ldo_service.schemas.topics import CONTROL, FROM_OUTSIDE, HEALTH
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.gate_process import guarded
from ldo_service.transport.key_renewal import KeyRenewal
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.worker import Worker
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport, open_session

from .metrics import HealthCollector
from .metrics_server import serve_metrics
from .state_folder import PAUSE_MARKER, RESET_MARKER, claim_state, write_config

log = logging.getLogger(__name__)

LEAVE_WITHIN_S = 1.0  # Time that a running step has to finish at the end of the service.


def open_recorder(
    folder: Path, actor: str, robot: str, config: Config, map_folder: Path | None = None
) -> Recorder:
    """Open a new recording file for an actor in this process.

    Args:
        folder: Folder of the recording.
        actor: Name of the actor.
        robot: Name of the robot.
        config: Configuration of the service.
        map_folder: Folder with the mapper's files; None if the recording needs none of them.

    Raises:
        ConfigError: The recording cannot be written to the folder.
    """
    about = {
        "actor": actor,
        "robot": robot,
        "config": config_yaml(config),
        "isa": kernels.isa(),
        "gpu": json.dumps(gpu_facts(config.service.device)),
        "versions": json.dumps(versions()),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = None
        if map_folder is not None and actor == Mapper.name:
            files = ActorFiles(map_folder, FILE_PATTERNS)
        return Recorder(new_path(folder, actor), about, recording_parameters(config), files)
    except OSError as error:
        raise ConfigError(
            f"the recording cannot be written to {folder}: {error.strerror}. Choose another folder "
            "with --record."
        ) from error


@dataclass(frozen=True, slots=True)
class Service:
    """Process of a live service: the main process, or a process with some of the actors only."""

    config: Config
    network: Endpoint
    state: Path  # State folder.
    # Actors to run in this process, if it is a child process or runs on another machine. Empty:
    # this is the main process, which runs or starts all actors except `service.remote_actors`.
    only: tuple[str, ...] = ()
    is_router: bool = True  # Open a router; False: connect to the network's router.
    # This process runs actors on another machine than the main process of the service.
    is_remote: bool = False
    is_state_kept: bool = True  # The state folder remains after the service ends.
    metrics_port: int | None = None  # Port for Prometheus; None: no metrics server.
    recording: Path | None = None  # Folder of the recording; None: no recording.

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM; a second signal stops immediately.

        Raises:
            ConfigError: The configuration or the state is invalid, or a port is in use.
            StageError: An actor has used up its restart budget, or a step took too long.
        """
        check_graph(GRAPH)
        self.config.check_timeouts()
        self._require_known(self.only)
        self._require_known(self.config.service.process_actors)
        raise_file_limit()
        names, silent_after_s = (
            [spec.name for spec in GRAPH],
            self.config.service.heartbeat_timeout_s,
        )
        keys = self.network.keys
        until_s = keys.valid_until_s() if keys else None
        health = HealthCollector(self.network.robot, names, silent_after_s, until_s)
        if self.recording and not self.only:
            prepare_recording(self.recording)
        with ExitStack() as stack:
            if not self.only:
                claim_state(self.state, stack, self.config.service.remote_actors)
            if self.metrics_port is not None:
                address = self.config.service.metrics_address
                stack.enter_context(serve_metrics(health, self.metrics_port, address))
            session = self._open_session(stack, health)
            try:
                asyncio.run(self._serve(session, health))
            except LdoError as error:
                _leave_if_busy(error.exit_code, str(error))
                raise
            _leave_if_busy(0, "stopped")
            if not self.only:
                self._keep_last_generation()
                log.info("service: stopped; %s", self._state_after_stop())

    def _open_session(self, stack: ExitStack, health: HealthCollector) -> zenoh.Session:
        """Open the session of this process; a router with keys gets a gate and key renewal."""
        network, gate = self.network, None
        if self.is_router and network.keys:
            network, gate = stack.enter_context(guarded(network))
        session = stack.enter_context(open_session(network, router=self.is_router))
        if gate is not None and network.local_socket:

            def renewed(keys: TlsKeys) -> None:
                health.certificate_until_s = keys.valid_until_s()

            stack.enter_context(KeyRenewal(gate, network, renewed))
        return session

    async def _serve(self, session: zenoh.Session, health: HealthCollector) -> None:
        transport = ZenohTransport(session, self.network)
        if self.metrics_port is not None:
            transport.subscribe(HEALTH.subscription_key, health.on_health)
        stop = StopRequest()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.request)
        watch = asyncio.create_task(self._stop_with_parent(stop))
        watchdog = Watchdog({} if self.only else os.environ)
        pings = asyncio.create_task(watchdog.ping())
        runners = self._runners(transport)
        generations = self._open_generations(transport)
        if generations:
            health.generation_age_s = generations.age_s
        keeping = asyncio.create_task(generations.run()) if generations else None
        control = None if self.only else self._open_control(transport, generations)
        names = ", ".join(runner.name for runner in runners)
        if self.only:  # The main process has already printed the start message.
            log.info("%s: ready", names)
        else:
            log.info("service: serving %s on %s", names, self.network.endpoint)
        watchdog.notify("READY=1")
        try:
            sources = sum(_is_fed_from_outside(actor_spec(runner.name)) for runner in runners)
            await supervise(runners, stop, self.config.service.shutdown_timeout_s, sources)
        finally:
            watchdog.notify("STOPPING=1")
            pings.cancel()
            watch.cancel()
            if keeping:
                keeping.cancel()
            if control:
                control.close()
            if generations:
                generations.close()
            transport.close()

    @property
    def _local_actors(self) -> list[str]:
        names = [spec.name for spec in GRAPH]
        return [name for name in names if name not in self.config.service.remote_actors]

    def _open_generations(self, transport: ZenohTransport) -> GenerationKeeper | None:
        """Return the keeper of generations of the states; a temporary state needs none."""
        if self.only or not self.is_state_kept:
            return None
        store = FolderStore(self.state / "state")
        local = self._local_actors
        actors = [spec.name for spec in consumers_first(GRAPH) if spec.name in local]
        return GenerationKeeper(CommandSender(transport), store, actors)

    def _keep_last_generation(self) -> None:
        """Keep the states of the stopped actors, so that a later power cut loses nothing."""
        if not self.is_state_kept:
            return
        try:
            keep_last(FolderStore(self.state / "state"), self._local_actors)
        except (OSError, DataError) as error:
            log.error(
                "%s: the last states cannot be kept as an older generation: %s. A power cut within "
                "the next minute may lose the last keyframes. Check the disk.",
                self.state, error,
            )  # fmt: skip

    def _open_control(
        self, transport: ZenohTransport, generations: GenerationKeeper | None
    ) -> Control:
        control = Control(
            transport,
            actors=[spec.name for spec in GRAPH],
            sources=[spec.name for spec in GRAPH if _is_fed_from_outside(spec)],
            saved_where=self._saved_where(),
            timeout_s=self.config.service.control_timeout_s,
            reset_marker=self.state / RESET_MARKER,
            pause_marker=self.state / PAUSE_MARKER,
            generations=generations,
        )
        transport.respond(CONTROL.name, control.answer)
        return control

    def _saved_where(self) -> str:
        if self.is_state_kept:
            return str(self.state)
        return f"{self.state}, which is deleted when the service ends (--state DIR keeps it)"

    def _state_after_stop(self) -> str:
        if self.is_state_kept:
            return f"state saved in {self.state}"
        return "its temporary state is deleted (--state DIR keeps it)"

    # --- stages and child processes ---------------------------------------------------------------
    def _runners(self, transport: ZenohTransport) -> list[Runner]:
        """Create the stages and child processes, in the order in which they finish."""
        children: dict[str, ChildProcess] = {}
        runners: list[Runner] = []
        suspects = asyncio.Lock()  # Shared by all stages of this process.
        for spec in finish_order(GRAPH):
            is_elsewhere = not self.only and spec.name in self.config.service.remote_actors
            if is_elsewhere or (self.only and spec.name not in self.only):
                continue
            if not self.only and spec.name in self.config.service.process_actors:
                children[spec.name] = self._child(spec, transport)
                runners.append(children[spec.name])
            else:
                runners.append(self._stage(spec, transport, children, suspects))
        return runners

    def _stage(
        self,
        spec: ActorSpec,
        transport: ZenohTransport,
        children: dict[str, ChildProcess],
        suspects: asyncio.Lock,
    ) -> Stage:
        def evicted(consumer: str) -> None:
            if consumer in children:
                children[consumer].kill()

        make = spec.make
        assert make is not None
        config = self.config.with_map_folder(self.state / "map")
        parameters = actor_parameters(config)
        # The state of a remote actor has no older generation, so each save has to be synced.
        syncs = self.config.service.fsync or self.is_remote
        has_generations = self.is_state_kept and not self.is_remote
        try:
            return Stage(
                lambda: make(parameters),
                transport,
                config=stage_parameters(self.config),
                store=FolderStore(
                    self.state / "state", syncs=syncs, has_generations=has_generations
                ),
                expected={
                    out.topic.name: lossless_consumers(GRAPH, out.topic.name)
                    for out in spec.outputs
                },
                with_backlog={
                    out.topic.name: consumers_with_backlog(GRAPH, out.topic.name)
                    for out in spec.outputs
                },
                on_evicted=evicted,
                journal=self._journal(spec.name, Path(config.mapper.image_folder)),
                heartbeat=start_heartbeat() if self.only else None,
                suspects=suspects,
                starts_paused=lambda: self._is_paused(spec),
            )
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise ConfigError(
                f"the state of {spec.name} in {self.state} does not fit this version ({error!r}). "
                "Choose another folder with --state, or delete this folder to start with an empty "
                "map."
            ) from error

    def _is_paused(self, spec: ActorSpec) -> bool:
        """Return whether a file says that an actor takes no messages; see `Control`."""
        is_paused = _is_fed_from_outside(spec) and (self.state / PAUSE_MARKER).exists()
        return is_paused or (self.state / RESET_MARKER).exists()

    def _journal(self, actor: str, map_folder: Path) -> Journal:
        if self.recording is None:
            return Journal()
        return open_recorder(self.recording, actor, self.network.robot, self.config, map_folder)

    def _child(self, spec: ActorSpec, transport: ZenohTransport) -> ChildProcess:
        config = write_config(self.state, config_yaml(self.config))
        command = python_command(
            *("serve", "--actor", spec.name, "--robot", self.network.robot),
            *("--endpoint", self.network.local_endpoint),
            *("--config", str(config), "--state", str(self.state)),
            *(("--record", str(self.recording)) if self.recording else ()),
        )
        stage = stage_parameters(self.config)
        return ChildProcess(
            spec.name,
            command,
            transport,
            max_restarts=stage.max_restarts,
            restart_window_s=stage.restart_window_s,
            restart_delay_s=stage.restart_delay_s,
            silent_after_s=self.config.service.heartbeat_timeout_s,
            step_timeout_s=stage.step_limit(spec.is_backend)[0],
        )

    async def _stop_with_parent(self, stop: StopRequest) -> None:
        if self.only:
            await exit_with_parent()
            stop.request()
            stop.request()

    def _require_known(self, names: Sequence[str]) -> None:
        for name in names:
            actor_spec(name)


def _is_fed_from_outside(spec: ActorSpec) -> bool:
    return any(port.topic in FROM_OUTSIDE for port in spec.inputs)


def _leave_if_busy(exit_code: int, why: str) -> None:
    """Exit the process immediately if a step is still running.

    The thread of the step cannot be stopped. A normal end of the interpreter would kill the thread
    inside a library, and the process would abort.
    """
    if busy := Worker.busy_workers(LEAVE_WITHIN_S):
        log.error("%s (exited during a step of %s)", why, ", ".join(busy))
        logging.shutdown()
        os._exit(exit_code)
