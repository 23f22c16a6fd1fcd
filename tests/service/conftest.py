"""Fixtures for a complete service in its own processes, as a user starts it."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import count, cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import pytest

from ldo_service.actors.topology import GRAPH
from ldo_service.client import Client, connect
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.errors import ConfigError
from ldo_service.geometry.sequence import Sequence as FrameSequence
from ldo_service.schemas import CameraRgbd, Health, TrackedPose
from ldo_service.transport.access_control import LOCAL
from tests.ports import free_endpoint

PATIENCE = 6  # Factor on all time limits, because test machines are busy with other work.
RESEND_AFTER_S = 1.0  # Time without a pose after which a frame is sent again.
MAX_COPIES = 1000  # Maximum number of copies of a frame, stamped 1 ns apart.
LDO = (sys.executable, "-m", "ldo_service")
# Options of a service that saves the whole map after each keyframe.
EVERY_KEYFRAME = ("--set", "mapper.checkpoint_interval_keyframes=1")


def wait_until(true: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait for a condition; `timeout_s` is the time limit on an idle machine."""
    patience_s = PATIENCE * timeout_s
    until_s = time.monotonic() + patience_s
    while not true():
        if time.monotonic() > until_s:
            pytest.fail(f"not {what} within {patience_s:g} s")
        time.sleep(0.05)


class LiveService:
    """Process of `ldo serve`, its log, and a client that receives health and poses."""

    def __init__(
        self,
        folder: Path,
        *arguments: str,
        command: Sequence[str] = LDO,
        keys: Path | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        """Start the service and connect to it.

        Args:
            folder: Folder of the log and of the state.
            arguments: Further arguments of `ldo serve`.
            command: The command `ldo`.
            keys: Folder with TLS keys of a service. The client then connects over the Unix socket
                of the service, which needs no keys.
            variables: Further environment variables.
        """
        self.endpoint, self.state = free_endpoint(), folder / "s"
        self._stack = ExitStack()
        self._address = self.endpoint  # Address to which the client connects.
        if keys is not None:
            self.endpoint = self.endpoint.replace("tcp/", "tls/")
            socket = f"{self._stack.enter_context(TemporaryDirectory())}/link"
            arguments = (*arguments, "--keys", str(keys), "--local-socket", socket)
            self._address = f"{LOCAL}/{socket}"
        self.log_path = folder / "serve.log"
        self._log = self.log_path.open("w")
        self.process = subprocess.Popen(
            [
                *command,
                "serve",
                "--endpoint",
                self.endpoint,
                "--state",
                str(self.state),
                *arguments,
            ],
            stderr=self._log,
            env={**os.environ, **(variables or {})},
        )
        self.health: dict[str, Health] = {}
        try:
            self.client = self._connect()
            self._health = self._stack.enter_context(self.client.poller("health/*", Health))
            self._poses = self._stack.enter_context(
                self.client.poller("pose/tracked", TrackedPose, keep=4096)
            )
        except BaseException:
            self.close()
            raise

    @property
    def log(self) -> str:
        return self.log_path.read_text()

    def _connect(self) -> Client:
        """Connect as soon as the router listens; an attempt before that fails at once."""
        until_s = time.monotonic() + PATIENCE * 20
        while True:
            try:
                return self._stack.enter_context(connect("robot", self._address))
            except ConfigError:
                assert self.process.poll() is None, self.log
                assert time.monotonic() < until_s, f"the service does not answer:\n{self.log}"
                time.sleep(0.2)

    def update_health(self) -> dict[str, Health]:
        self.health.update({health.actor: health for health in self._health()})
        return self.health

    def wait_for_actors(self, count: int = len(GRAPH)) -> None:
        wait_until(lambda: len(self.update_health()) == count, 20, "all actors report")

    def poses(self) -> list[TrackedPose]:
        """Return the poses received since the last call."""
        return self._poses()

    def wait_for_poses(self, count: int, timeout_s: float = 20) -> list[TrackedPose]:
        poses: list[TrackedPose] = []

        def enough() -> bool:
            assert self.process.poll() is None, self.log
            poses.extend(self.poses())
            return len(poses) >= count

        wait_until(enough, timeout_s, f"{count} poses (log: {self.log})")
        return poses

    def send_until(
        self,
        frame: CameraRgbd,
        is_done: Callable[[], bool],
        timeout_s: float,
        what: str,
        send: Callable[[CameraRgbd], None] | None = None,
    ) -> None:
        """Send a frame each second until a condition holds: a busy machine may drop any frame.

        Args:
            frame: The frame. Each copy is stamped 1 ns after the one before, because a stamp that
                comes twice is rejected.
            is_done: The condition.
            timeout_s: The time limit on an idle machine.
            what: The condition in words, for the failure message.
            send: The function that sends a copy; by default `self.client.send`.
        """
        copies = count()
        due_s = time.monotonic()

        def is_done_after_sending() -> bool:
            nonlocal due_s
            assert self.process.poll() is None, self.log
            if is_done():
                return True
            if time.monotonic() >= due_s:
                stamp_ns = frame.stamp_ns + next(copies)
                (send or self.client.send)(msgspec.structs.replace(frame, stamp_ns=stamp_ns))
                due_s = time.monotonic() + RESEND_AFTER_S
            return False

        wait_until(is_done_after_sending, timeout_s, what)

    def pose_of(
        self, frame: CameraRgbd, send: Callable[[CameraRgbd], None] | None = None
    ) -> TrackedPose:
        """Send a frame until its pose arrives, and return the pose."""
        found: list[TrackedPose] = []

        def has_come() -> bool:
            found.extend(
                pose
                for pose in self.poses()
                if frame.stamp_ns <= pose.stamp_ns < frame.stamp_ns + MAX_COPIES
            )
            return bool(found)

        self.send_until(frame, has_come, 20, f"a pose of frame {frame.frame}", send)
        return found[0]

    def publisher(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [*LDO, "publish", *arguments, "--endpoint", self.endpoint]
        return self.start(command, stderr=subprocess.DEVNULL)

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a program that is killed with the service, whether the test passes or fails.

        A process that a failed test leaves behind would be reported in a later test.
        """
        program = subprocess.Popen(command, **options)
        self._stack.callback(_end, program)
        return program

    @contextmanager
    def camera(self, frames: FrameSequence, rate_hz: float = 5) -> Iterator[None]:
        """Send a sequence that ends where it begins, again and again, until the block ends.

        Args:
            frames: The sequence; each frame is stamped with the time at which it is sent.
            rate_hz: The frame rate. It is low, so that a busy machine tracks consecutive frames.
        """
        is_over = threading.Event()

        def send_all() -> None:
            for index in cycle(range(len(frames))):
                if is_over.wait(1 / rate_hz):
                    return
                frame = raw_frame_to_message(frames.read(index))
                self.client.send(msgspec.structs.replace(frame, stamp_ns=time.time_ns()))

        with ThreadPoolExecutor(1) as thread:
            sending = thread.submit(send_all)
            try:
                yield
            finally:
                is_over.set()
            sending.result()

    def stop(self, number: signal.Signals = signal.SIGINT, timeout_s: float = 15) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE * timeout_s)

    def close(self) -> None:
        self._stack.close()
        _end(self.process)
        self._log.close()


def _end(program: subprocess.Popen[Any]) -> None:
    program.kill()
    program.wait()
    for pipe in (program.stdin, program.stdout):
        if pipe is not None:
            pipe.close()


@contextmanager
def live_service(
    folder: Path, *arguments: str, command: Sequence[str] = LDO, **options: Any
) -> Iterator[LiveService]:
    service = LiveService(folder, *arguments, command=command, **options)
    try:
        yield service
    finally:
        service.close()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"


def metric(service: LiveService, actor: str, name: str) -> float:
    """Return a metric in the last heartbeat of an actor; 0 if it has none."""
    health = service.update_health().get(actor)
    return health.metrics.get(name, 0.0) if health else 0.0


@contextmanager
def service_with_map(
    folder: Path, frames: FrameSequence, keyframes: int = 8
) -> Iterator[LiveService]:
    """Run a service whose mapper has saved a map of at least so many keyframes."""
    with live_service(folder, *EVERY_KEYFRAME) as service:
        service.wait_for_actors()
        with service.camera(frames):
            wait_until(lambda: metric(service, "mapper", "keyframes") >= keyframes, 60, "a map")
        yield service
