"""Service under test on one state folder, and access to its saved and published state."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from ldo_service.actors.mapper import Mapper
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.topology import GRAPH
from ldo_service.client import Client, connect
from ldo_service.config import actor_parameters, load_config
from ldo_service.conversions.objects import map_objects
from ldo_service.errors import ConfigError, StageError
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.maps.replica import MapReplica
from ldo_service.runtime.delivery_state import RestoredState, restore_actor
from ldo_service.schemas import GraphCorrection, MapObject, MapObjects, MapSnapshot
from ldo_service.schemas.topics import GRAPH_CORRECTION, MAP_OBJECTS, MAP_SNAPSHOT
from ldo_service.semantics.semantic_map import SemanticMap
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_endpoint, free_port

from .message_recorder import MessageRecorder

PROGRAM = Path(__file__).with_name("faulty_service.py")
PATIENCE_S = 120.0  # Time limit on a busy machine.
ACTORS = tuple(box.name for box in GRAPH)
ALL_APART = f"service.process_actors=[{','.join(ACTORS)}]"
LIGHT = (  # Little work per keyframe and short timeouts, because the runtime is tested.
    *(
        "mapper.iterations=2",
        "mapper.threads=1",
        "supervision.step_timeout_s=4",
        "supervision.backend_step_timeout_s=4",
        "supervision.heartbeat_s=0.25",
    ),
    *(
        "service.heartbeat_timeout_s=5",
        "supervision.max_restarts=1000",
        "service.shutdown_timeout_s=60",
    ),
    "detector.model=demo",  # This model finds some objects in the room.
)
DEFAULT = ("detector.model=demo",)
RESTART_S = 5.0  # Time after which systemd starts a failed service again: RestartSec of the unit.


class NotRecovered(Exception):
    pass


@dataclass(frozen=True)
class PublishedState:
    """Map, objects and graph that a service publishes."""

    map: MapReplica
    objects: tuple[MapObject, ...] | None  # Unset (None) before the first message.
    graph: GraphCorrection | None

    @classmethod
    def of(cls, messages: Iterable[Any]) -> "PublishedState | None":
        """Build the published state from messages; return None without a map."""
        replica, objects, graph = MapReplica(), None, None
        for message in messages:
            match message:
                case MapObjects():
                    objects = message.objects
                case GraphCorrection():
                    graph = message
                case _:
                    replica.apply(message)
        return cls(replica, objects, graph) if replica.version else None


class ServiceProcess:
    """Service that can be started again on the same state after a `kill`.

    Attributes:
        ends: Times that the service ended without being killed, and was started again as systemd
            does. This happens only with `has_defaults`.
        on_end: Function that starts the service again after such an end.
    """

    def __init__(
        self,
        folder: Path,
        recorder: MessageRecorder,
        settings: tuple[str, ...],
        *,
        has_defaults: bool = False,
    ) -> None:
        """Choose the settings.

        Args:
            folder: Folder of the state and of the files that switch faults on.
            recorder: Recorder of the messages.
            settings: Further settings.
            has_defaults: Run with default settings and TLS keys, instead of little work per
                keyframe, short timeouts and no limit of restarts.
        """
        self.folder, self.recorder = folder, recorder
        self.settings = (*(DEFAULT if has_defaults else LIGHT), *settings)
        self.keys = _new_keys(folder) if has_defaults else None
        self.ends, self.on_end = 0, self.start
        self.log: deque[str] = deque(maxlen=400)
        self._stack = ExitStack()

    @property
    def state(self) -> Path:
        return self.folder / "s"

    # --- start and stop ---------------------------------------------------------------------------
    def start(self) -> None:
        settings = [word for setting in self.settings for word in ("--set", setting)]
        if self.keys is None:
            network = Endpoint("robot", free_endpoint())
        else:
            endpoint = f"tls/127.0.0.1:{free_port()}"
            network = Endpoint("robot", endpoint, TlsKeys.of(self.keys))
            settings += ["--keys", str(self.keys)]
        self.process = subprocess.Popen(
            [
                *(sys.executable, str(PROGRAM), "serve", "--endpoint", network.endpoint),
                *("--state", str(self.state), *settings),
            ],
            env={**os.environ, "FAULT_FOLDER": str(self.folder), "OMP_NUM_THREADS": "1"},
            stderr=subprocess.PIPE,
            text=True,
        )
        Thread(target=self._read_log, args=(self.process,), daemon=True).start()
        self.recorder.health.clear()
        self.recorder.pose = None
        self.client = self._connect(network)
        session = self._stack.enter_context(open_session(network))
        self.recorder.listen(session, network)

    def _read_log(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr
        with process.stderr as log:
            self.log.extend(iter(log.readline, ""))

    def _connect(self, network: Endpoint) -> Client:
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s and self.process.poll() is None:
            try:
                return self._stack.enter_context(connect("robot", network.endpoint, self.keys))
            except ConfigError:
                time.sleep(0.2)
        raise NotRecovered(f"the service does not answer:\n{self.tail()}")

    def kill(self) -> None:
        """Send SIGKILL to all processes of the service at once."""
        self.recorder.update()
        pids = {self.process.pid, *(health.pid for _, health in self.recorder.health.values())}
        for pid in pids | children_of(self.process.pid):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
        self.close()

    def close(self) -> None:
        self._stack.close()
        self._stack = ExitStack()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(PATIENCE_S)
        finally:
            self.close()

    def tail(self, lines: int = 40) -> str:
        return "".join(list(self.log)[-lines:])

    def wait(self, what: str, true: Callable[[], object], timeout_s: float = PATIENCE_S) -> float:
        """Wait for a condition and return the seconds it took.

        Raises:
            NotRecovered: The service has ended, or the time limit is over.
        """
        started_s = time.monotonic()
        while True:
            self.recorder.update()
            if true():
                return time.monotonic() - started_s
            if self.process.poll() == StageError.exit_code and self.keys is not None:
                self.ends += 1
                time.sleep(RESTART_S)
                self.on_end()
            elif self.process.poll() is not None:
                raise NotRecovered(
                    f"the service ended with status {self.process.returncode} before: {what}"
                )
            if time.monotonic() - started_s > timeout_s:
                raise NotRecovered(f"did not happen within {timeout_s:g} s: {what}")
            time.sleep(0.02)

    # --- content of the map -----------------------------------------------------------------------
    def saved_map(self) -> dict[str, np.ndarray]:
        """Return the state of the mapper from its checkpoint on the disk."""
        state = FolderStore(self.state / "state").load("mapper")
        assert state is not None
        return state["map"]

    def published(self) -> PublishedState | None:
        """Return the published state that a new subscriber receives."""
        topics = MAP_SNAPSHOT, MAP_OBJECTS, GRAPH_CORRECTION
        return PublishedState.of(
            message for topic in topics for message in self.client.latest(topic, 10)
        )

    def expected(self) -> PublishedState | None:
        """Return the state that a service restored from the disk must publish.

        It is the checkpoint with the write-ahead log replayed in this process. It is None before
        the first keyframe.
        """
        store = FolderStore(self.state / "state")
        past, of_graph = (
            RestoredState.of(store.load("mapper")),
            RestoredState.of(store.load("optimizer")),
        )
        if not past.of_actor:
            return None
        copy = self.folder / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.state / "map", copy)
        config = load_config(settings=self.settings).with_map_folder(copy)
        parameters = actor_parameters(config)

        def mapper() -> Mapper:
            return Mapper(parameters.mapper)

        def optimizer() -> Optimizer:
            return Optimizer(parameters.optimizer)

        messages = [
            *restore_actor(mapper(), past, mapper).on_restored(),
            *restore_actor(optimizer(), of_graph, optimizer).on_restored(),
        ]
        return PublishedState.of(
            m for m in messages if isinstance(m, MapSnapshot | MapObjects | GraphCorrection)
        )


def _new_keys(folder: Path) -> Path:
    """Create keys for the service, which may use all topics, and return their folder."""
    authority = CertificateAuthority.new(folder / "keys", days=400)
    authority.add("service", "service", "robot", days=365)
    return folder / "keys" / "service"


def saved_objects(state: Mapping[str, Any]) -> tuple[MapObject, ...]:
    """Return the objects in the checkpoint of the mapper."""
    semantics = SemanticMap(MapBuilder())
    semantics.restore(state["semantics"])
    return map_objects(semantics.objects.landmarks, semantics.names)


def arrays_of(replica: MapReplica) -> dict[str, np.ndarray]:
    return replica.map.snapshot()


def difference(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> str:
    """Describe the first difference of two maps; return "" if they are equal bit by bit."""
    for name in ("ids", "anchors", "rows", "labels"):
        a, b = one[name], other[name]
        if a.shape != b.shape:
            return f"{name} {a.shape} and {b.shape}"
        if a.tobytes() != b.tobytes():
            others = np.flatnonzero((a != b).reshape(len(a), -1).any(axis=1))
            anchors = sorted(set(one["anchors"][others].tolist()))
            return f"{name}: {len(others)} of {len(a)}, of keyframes {anchors}"
    return ""


def objects_difference(one: Iterable[MapObject], other: Iterable[MapObject]) -> str:
    """Describe the differences of objects by id: missing ones and different fields."""
    a, b = ({thing.id: thing for thing in things} for things in (one, other))
    fields = [
        f"{name} of {k}: {before} and {now}"
        for k in sorted(a.keys() & b.keys())
        for name in a[k].__struct_fields__
        if (before := getattr(a[k], name)) != (now := getattr(b[k], name))
    ]
    alone = [f"only in one: {sorted(a.keys() ^ b.keys())}"] if a.keys() != b.keys() else []
    return "; ".join([*alone, *fields])[:400]


def children_of(pid: int) -> set[int]:
    try:
        return set(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))
    except OSError:
        return set()
