"""Process of `ldo serve` of the installed package, which may be the package of commit 18f9264."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any
from urllib.request import urlopen

import msgspec
import zenoh

from ldo_service.errors import ConfigError
from tests.faults.earlier_names import found, name
from tests.ports import free_port

encode, decode = msgspec.msgpack.encode, msgspec.msgpack.decode
ACTORS = frozenset(
    ("frame_source", "tracker", "detector", "vlm_labeller", "mapper", "loop_closer", "optimizer")
)
PATIENCE_S = 240.0  # Time limit of each condition, on an overloaded machine.
PREFIX = "ldo/robot/"
COMMAND = (sys.executable, "-m", "ldo_service")
CHANGED = (sys.executable, str(Path(__file__).with_name("changed_serve.py")), "serve")
LIGHT = ("mapper.iterations=2", "mapper.threads=1")  # Settings for little work per keyframe.


class NotObserved(Exception):
    """Condition that was not reached, so that the program has no verdict."""


@contextmanager
def new_folder() -> Iterator[Path]:
    with TemporaryDirectory(prefix="ldo-fault-", ignore_cleanup_errors=True) as path:
        yield Path(path)


def wait(what: str, is_true: Callable[[], object], limit_s: float = PATIENCE_S) -> float:
    """Wait for a condition and return the seconds it took.

    Raises:
        NotObserved: The condition is not true within the limit.
    """
    started_s = time.monotonic()
    while not is_true():
        if time.monotonic() - started_s > limit_s:
            raise NotObserved(f"not within {limit_s:g} s: {what}")
        time.sleep(0.05)
    return time.monotonic() - started_s


class Serve:
    """Process of `ldo serve`, and the last heartbeat of each actor, as decoded messages.

    Attributes:
        health: Last heartbeat of each actor, with the field names of the installed package.
        beats: Number of heartbeats of each actor.
    """

    def __init__(
        self,
        folder: Path,
        *arguments: str,
        settings: Sequence[str] = (),
        command: Sequence[str] = (*COMMAND, "serve"),
        keys: Path | None = None,
        max_files: int = 0,
        port: int = 0,
        env: dict[str, str] | None = None,
    ) -> None:
        """Start the process; use the object in a `with` block, which ends the process.

        Args:
            folder: Folder of the state and the log, in which the process runs.
            arguments: Further arguments.
            settings: Settings, by the names of the installed package.
            command: The command without arguments.
            keys: Folder with the keys of the service, which then uses TLS.
            max_files: Limit of open files; 0 for the limit of this process.
            port: Port of the router; 0 for a free one.
            env: Further environment variables.
        """
        self.port = port or free_port()
        self.endpoint = f"{'tls' if keys else 'tcp'}/127.0.0.1:{self.port}"
        self.folder, self.state = folder, folder / "state"
        self.health: dict[str, dict[str, Any]] = {}
        self.beats: Counter[str] = Counter()
        words = [*command, "--endpoint", self.endpoint, "--state", str(self.state), *arguments]
        words += ["--keys", str(keys)] if keys else []
        for setting in settings:
            words += ["--set", setting]
        limit = f"ulimit -n {max_files}; " if max_files else ""
        self._log_path = folder / f"log-{time.time_ns()}.txt"
        self._log = self._log_path.open("w")
        self.started_s = time.monotonic()
        self.process = subprocess.Popen(
            ["bash", "-c", f'{limit}exec "$@"', "-", *words],
            stdout=self._log,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", **(env or {})},
        )
        self._pids = {self.process.pid}

    def __enter__(self) -> "Serve":
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._log.close()

    @property
    def log(self) -> str:
        return self._log_path.read_text()

    def kill(self) -> None:
        """Send SIGKILL to all processes of the service at once."""
        self._pids |= children_of(self.process.pid)
        self.process.kill()
        for pid in self._pids - {self.process.pid}:
            with suppress(OSError):
                if b"serve" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> int:
        """Stop the service as systemd does, and return its exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

    # --- conditions -------------------------------------------------------------------------------
    def exit_code(self, limit_s: float = PATIENCE_S) -> int:
        """Wait for the end of the process and return its exit code.

        Raises:
            NotObserved: The process does not end within the limit.
        """
        wait("the service ends", lambda: self.process.poll() is not None, limit_s)
        return self.process.returncode

    def ends_before(
        self, what: str, is_true: Callable[[], object], limit_s: float = PATIENCE_S
    ) -> bool:
        """Return whether the service ends before a condition is true.

        Raises:
            NotObserved: Neither happens within the limit.
        """
        wait(what, lambda: self.process.poll() is not None or is_true(), limit_s)
        return self.process.poll() is not None

    def wait(self, what: str, is_true: Callable[[], object], limit_s: float = PATIENCE_S) -> float:
        """Wait for a condition of a running service, and return the seconds it took.

        Raises:
            NotObserved: The condition is not true within the limit, or the service ends before.
        """
        started_s = time.monotonic()
        if self.ends_before(what, is_true, limit_s):
            code = self.process.returncode
            raise NotObserved(f"the service ended with {code} before: {what}\n{self.log[-1500:]}")
        return time.monotonic() - started_s

    @contextmanager
    def running(self, keys: Path | None = None) -> Iterator[zenoh.Session]:
        """Wait until all actors are ready, and yield a session that receives the heartbeats."""
        with self.session(keys) as session:
            subscriber = session.declare_subscriber(f"{PREFIX}health/*", self._hear)
            self.wait("all actors are ready", self._is_ready)
            self._pids |= children_of(self.process.pid)
            yield session
            subscriber.undeclare()

    @contextmanager
    def session(self, keys: Path | None = None) -> Iterator[zenoh.Session]:
        """Yield a session of another program, which has connected to the service."""
        of_keys = found("TlsKeys").of(keys)
        sessions: list[Any] = []

        def is_open() -> bool:
            with suppress(ConfigError):
                endpoint = found("Endpoint")("robot", self.endpoint, of_keys)
                sessions.append(found("open_session")(endpoint))
            return bool(sessions)

        self.wait("the router is open", is_open)
        with sessions[0] as session:
            yield session

    def _hear(self, sample: zenoh.Sample) -> None:
        health = decode(sample.payload.to_bytes())
        self.health[health["actor"]] = health
        self.beats[health["actor"]] += 1

    def _is_ready(self) -> bool:
        return self.health.keys() >= ACTORS and all(
            health["state"] != "starting" for health in self.health.values()
        )

    def new_heartbeats(self, count: int = 4, actors: frozenset[str] = ACTORS) -> bool:
        """Return whether all actors have sent so many heartbeats since `forget_heartbeats`."""
        return all(self.beats[actor] >= count for actor in actors)

    def forget_heartbeats(self) -> None:
        self.beats.clear()

    def metric(self, actor: str, of_actor: str) -> float:
        """Return a metric of an actor by its name, 0 before it is known."""
        return self.health.get(actor, {}).get(name("metrics"), {}).get(of_actor, 0.0)

    def heartbeat_age_s(self, actor: str, metrics_port: int) -> float:
        """Return the age of a heartbeat on the page of metrics, seconds; infinity without one."""
        with (
            suppress(OSError),
            urlopen(f"http://127.0.0.1:{metrics_port}/metrics", timeout=5) as page,
        ):
            for line in page.read().decode().splitlines():
                if line.startswith("ldo_heartbeat_age_seconds{") and f'actor="{actor}"' in line:
                    return float(line.rpartition(" ")[2])
        return float("inf")


def input_count(serve: Serve, actor: str, topic: str, *counters: str) -> int:
    """Return the sum of counters of an input from the last heartbeat of its actor."""
    inputs = serve.health[actor]["inputs"]
    return sum(i[counter] for i in inputs if i["topic"] == topic for counter in counters)


def starts_with_code_2(serve: Serve) -> bool:
    """Return whether a start ends with exit code 2, as for a typing error."""
    try:
        with serve.running():
            print("all actors run")
            return False
    except NotObserved:
        code = serve.exit_code(5.0)
        print(f"exit code {code}")
        return code == 2


# --- messages of other programs -------------------------------------------------------------------
def put(session: zenoh.Session, topic: str, body: bytes, header: bytes | None = None) -> None:
    session.put(PREFIX + topic, body, attachment=header)


def control(session: zenoh.Session, command: str, limit_s: float = PATIENCE_S) -> tuple[bool, str]:
    """Send a command, and return whether all actors carried it out, and the reply's text."""
    request = {"type": "ControlRequest", "stamp_ns": 0, name("command"): command}
    for reply in session.get(f"{PREFIX}control", payload=encode(request), timeout=limit_s):
        if reply.ok is None:
            return False, "refused"
        answer = decode(reply.ok.payload.to_bytes())
        return answer["ok"], answer[name("message")]
    return False, "no answer"


class Camera:
    """Camera that sends the same frames again and again, with increasing stamps."""

    def __init__(self, scene: Sequence[dict[str, Any]], rate_hz: float = 4.0) -> None:
        there = list(scene)
        self._scene, self.period_s, self.sent = there + there[-2:0:-1], 1 / rate_hz, 0

    @contextmanager
    def streaming(self, session: zenoh.Session) -> Iterator[None]:
        stop = Event()
        thread = Thread(target=self._stream, args=(session, stop), daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def _stream(self, session: zenoh.Session, stop: Event) -> None:
        while not stop.wait(self.period_s):
            number = {"frame": self.sent, "stamp_ns": 10**9 + self.sent * 10**8}
            try:
                put(
                    session,
                    "camera/rgbd",
                    encode(self._scene[self.sent % len(self._scene)] | number),
                )
            except zenoh.ZError:
                return  # The session has ended.
            self.sent += 1


def map_keyframes(serve: Serve, session: zenoh.Session, camera: Camera, count: int) -> None:
    """Send frames until the map has so many keyframes."""
    with camera.streaming(session):
        serve.wait(f"{count} keyframes", lambda: serve.metric("mapper", "keyframes") >= count)


def children_of(pid: int) -> set[int]:
    found_pids = set[int]()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found_pids.add(int(stat.parent.name))
    return found_pids
