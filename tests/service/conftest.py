"""A whole service in processes of its own, as a user starts it."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from ldo_service.actors.topology import GRAPH
from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError
from ldo_service.schemas import Health, TrackedPose

PATIENCE = 4  # machines that run tests do other things too: a test waits, it measures no time
LDO = (sys.executable, "-m", "ldo_service")


def free_endpoint() -> str:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


def wait_until(true: Callable[[], bool], timeout_s: float, what: str) -> None:
    """`timeout_s` on a machine with nothing else to do."""
    patience_s = PATIENCE * timeout_s
    until_s = time.monotonic() + patience_s
    while not true():
        if time.monotonic() > until_s:
            pytest.fail(f"not {what} within {patience_s:g} s")
        time.sleep(0.05)


class LiveService:
    """`ldo serve`, its log, and a client that listens to health and poses."""

    def __init__(self, folder: Path, *arguments: str, command: Sequence[str] = LDO) -> None:
        self.endpoint, self.state = free_endpoint(), folder / "s"
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
        )
        self._stack = ExitStack()
        self.client = self._connect()
        self._health = self._stack.enter_context(self.client.listen("health/*", Health))
        self._poses = self._stack.enter_context(
            self.client.listen("pose/tracked", TrackedPose, keep=4096)
        )
        self.health: dict[str, Health] = {}

    @property
    def log(self) -> str:
        return self.log_path.read_text()

    def _connect(self) -> Client:
        for _ in range(20):
            try:
                return self._stack.enter_context(connect("robot", self.endpoint))
            except ConfigError:
                assert self.process.poll() is None, self.log
                time.sleep(0.2)
        pytest.fail(f"the service does not answer:\n{self.log}")

    def update_health(self) -> dict[str, Health]:
        self.health.update({health.actor: health for health in self._health()})
        return self.health

    def wait_for_actors(self, count: int = len(GRAPH)) -> None:
        wait_until(lambda: len(self.update_health()) == count, 20, "all actors report")

    def poses(self) -> list[TrackedPose]:
        """Those that came since the last call."""
        return self._poses()

    def wait_for_poses(self, count: int, timeout_s: float = 20) -> list[TrackedPose]:
        poses: list[TrackedPose] = []

        def enough() -> bool:
            assert self.process.poll() is None, self.log
            poses.extend(self.poses())
            return len(poses) >= count

        wait_until(enough, timeout_s, f"{count} poses (log: {self.log})")
        return poses

    def publisher(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [*LDO, "publish", *arguments, "--endpoint", self.endpoint]
        return subprocess.Popen(command, stderr=subprocess.DEVNULL)

    def stop(self, number: signal.Signals = signal.SIGINT, timeout_s: float = 15) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE * timeout_s)

    def close(self) -> None:
        self._stack.close()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._log.close()


@contextmanager
def live_service(
    folder: Path, *arguments: str, command: Sequence[str] = LDO
) -> Iterator[LiveService]:
    service = LiveService(folder, *arguments, command=command)
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
