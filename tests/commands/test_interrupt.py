"""Exit of programs on SIGINT and SIGTERM, also when started in the background of a script."""

import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_endpoint
from tests.service.conftest import LDO, PATIENCE, wait_until

# A shell without job control starts a background job with SIGINT ignored.
IGNORING = ("bash", "-c", 'trap "" INT; exec "$@"', "bash")

both_signals = pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name
)


class Program:
    """The program `ldo` in a process that was started with SIGINT ignored."""

    def __init__(self, log: Path, *arguments: str | Path) -> None:
        self._log = log
        with log.open("w") as output:
            self.process = subprocess.Popen([*IGNORING, *LDO, *arguments], stderr=output)

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_until(self, is_ready: Callable[[], bool]) -> None:
        def is_ready_while_running() -> bool:
            assert self.process.poll() is None, self.log
            return is_ready()

        wait_until(is_ready_while_running, 20, "the program is ready")

    def end_with(self, number: signal.Signals) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE * 20)


@contextmanager
def started(log: Path, *arguments: str | Path) -> Iterator[Program]:
    program = Program(log, *arguments)
    try:
        yield program
    finally:
        program.process.kill()
        program.process.wait()


@both_signals
def test_viewer_serves_a_run_on_loopback_and_exits_with_0(
    run: Path, tmp_path: Path, number: signal.Signals
) -> None:
    with started(tmp_path / "log", "view", run, "--set", "viewer.port=0") as viewer:
        viewer.wait_until(lambda: "http://" in viewer.log)
        words = viewer.log.split()
        assert words[:3] == ["ldo", "view", "run"]
        assert words[-1].startswith("http://127.0.0.1:")
        with urllib.request.urlopen(words[-1]) as page:
            assert page.headers["Content-Type"] == "text/html"
        assert viewer.end_with(number) == 0
        assert len(viewer.log.splitlines()) == 1


def test_interrupted_service_exits_with_0(tmp_path: Path) -> None:
    with started(tmp_path / "log", "serve", "--endpoint", free_endpoint()) as service:
        service.wait_until(lambda: "serving" in service.log)
        assert service.end_with(signal.SIGINT) == 0
        assert "Traceback" not in service.log
        assert "service: stopped; its temporary state is deleted" in service.log


def test_service_prints_one_line_when_it_starts_and_the_state_folder_at_the_end(
    tmp_path: Path,
) -> None:
    state = tmp_path / "state"
    apart = "--set", "service.process_actors=[optimizer]"
    at = "--endpoint", free_endpoint(), "--state", state
    with started(tmp_path / "log", "serve", *at, *apart) as service:
        service.wait_until(lambda: "optimizer: ready" in service.log)
        assert service.end_with(signal.SIGINT) == 0
        assert service.log.count("serving") == 1
        assert service.log.count("stopped;") == 1
        assert f"service: stopped; state saved in {state}" in service.log


@both_signals
def test_interrupted_run_exits_with_130_and_keeps_partial_results(
    tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "out"
    with started(tmp_path / "log", "run", "synthetic:room", "--out", out) as run:
        run.wait_until(out.exists)
        assert run.end_with(number) == 130
        assert "ldo: interrupted; partial results are kept." in run.log
        assert "Traceback" not in run.log


def test_interrupted_publisher_exits_with_130(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    slowly = "--rate", "1", "--endpoint", endpoint
    with open_session(Endpoint("robot", endpoint), router=True) as session:
        frames = session.declare_subscriber("ldo/robot/camera/rgbd", zenoh.handlers.RingChannel(1))
        with started(tmp_path / "log", "publish", "synthetic:room", *slowly) as publisher:
            publisher.wait_until(lambda: frames.try_recv() is not None)
            assert publisher.end_with(signal.SIGINT) == 130
            assert "ldo: interrupted." in publisher.log
            assert "Traceback" not in publisher.log


# It sends the signal when the import of `gtsam` begins.
INTERRUPTED_IMPORT = """
import os, sys
from ldo_service.commands.cli import main

class Interrupter:
    def find_spec(name, *_):
        if name == "gtsam":
            os.kill(os.getpid(), int(sys.argv[1]))

sys.meta_path.insert(0, Interrupter)
main(["topics"])
"""


@both_signals
def test_signal_during_the_imports_ends_the_process_without_traceback(
    number: signal.Signals,
) -> None:
    command = sys.executable, "-c", INTERRUPTED_IMPORT, str(int(number))
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 130
    assert ended.stderr == ""
