"""Tests of actors in their own processes, which are killed and stopped."""

import asyncio
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from ldo_service.errors import RestartsExhausted
from ldo_service.runtime.actor import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.process import (
    PARENT_VARIABLE,
    ChildProcess,
    exit_with_parent,
    python_command,
    resident_mb,
    trim_memory,
)
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.schemas import Health, decode, encode
from ldo_service.transport.interface import MemoryTransport
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport
from tests.schemas.examples import EXAMPLES

from .fake_actors import NUMBERS, eventually, number, running, send

PROGRAM = Path(__file__).with_name("collector_process.py")


def command(network: Endpoint, numbers: Path, step_s: float = 0.0) -> list[str]:
    return [sys.executable, str(PROGRAM), network.endpoint, str(numbers), str(step_s)]


def read(numbers: Path) -> list[int]:
    return [int(line) for line in numbers.read_text().split()] if numbers.exists() else []


def child(code: str, **options: Any) -> ChildProcess:
    program = [sys.executable, "-c", code]
    return ChildProcess("child", program, MemoryTransport(), restart_delay_s=0.001, **options)


def pid_of(process: ChildProcess) -> int:
    """Return the id of a started process; a signal to 0 would go to the group of the tests."""
    assert process.pid
    return process.pid


async def test_killed_unexpected_consumer_releases_the_window(
    network: Endpoint, client: Callable[[], zenoh.Session], tmp_path: Path
) -> None:
    source = Outlet(Out(NUMBERS), "producer", 1, ZenohTransport(client(), network))
    numbers = tmp_path / "numbers"
    process = subprocess.Popen(command(network, numbers, step_s=100))
    try:
        await eventually(lambda: source.credits() == 4)
        for value in range(4):
            await send(source, number(value))
        await eventually(lambda: read(numbers) == [0])
        waiting = asyncio.create_task(send(source, number(4)))
        await asyncio.sleep(0.05)
        assert not waiting.done()
        process.kill()
        await asyncio.wait_for(waiting, 60)
    finally:
        process.kill()
        process.wait()


async def test_killed_and_stopped_processes_are_restarted_without_loss(
    network: Endpoint, client: Callable[[], zenoh.Session], tmp_path: Path
) -> None:
    numbers, transport = tmp_path / "numbers", ZenohTransport(client(), network)
    source = Outlet(Out(NUMBERS), "producer", 1, transport, ["collector"])
    process = ChildProcess(
        "collector",
        command(network, numbers, 0.01),
        transport,
        silent_after_s=1.0,
        step_timeout_s=1.0,
        max_restarts=100,
    )
    stop = StopRequest()
    service = asyncio.create_task(supervise([process], stop))
    for value in range(60):
        await send(source, number(value))
        if value == 20:
            os.kill(pid_of(process), signal.SIGKILL)
        if value == 40:
            os.kill(pid_of(process), signal.SIGSTOP)
    await source.flush()
    assert process.restarts >= 2
    stop.request()
    await service
    handled = read(numbers)
    assert set(handled) == set(range(60))
    # Each restart repeats at most the step in progress and one that was not yet acknowledged.
    assert len(handled) - 60 <= 2 * process.restarts
    assert process.pid is not None
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)


async def test_process_that_keeps_failing_exhausts_its_restarts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    failing = child("import sys; sys.exit(3)", max_restarts=2)
    with pytest.raises(RestartsExhausted, match="child failed 3 times"):
        await failing.run()
    assert failing.restarts == 2
    assert "ended with exit code 3" in caplog.text


async def test_process_that_cannot_be_started_is_tried_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    start, failures = asyncio.create_subprocess_exec, list(range(2))

    async def start_later(*command: Any, **options: Any) -> asyncio.subprocess.Process:
        if failures:
            failures.pop()
            raise OSError(12, "Cannot allocate memory")
        return await start(*command, **options)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start_later)
    process = child("import time; time.sleep(1e6)")
    async with running(process):
        await eventually(lambda: process.pid is not None)
    assert process.restarts == 2
    assert "its process cannot be started: Cannot allocate memory" in caplog.text


async def test_silent_process_is_restarted() -> None:
    silent = child("import time; time.sleep(1e6)", start_within_s=0.1, silent_after_s=0.1)
    async with running(silent):
        await eventually(lambda: silent.restarts >= 2)


# Program that starts its heartbeat and a step, writes a file, and runs C code for a given time.
STEP = """
import ctypes, pathlib, sys
from ldo_service.runtime.process_heartbeat import start_heartbeat
heartbeat = start_heartbeat()
heartbeat.begin()
pathlib.Path({file!r}).touch()
ctypes.{library}(None).sleep(1000)
"""


def health_of(process: ChildProcess) -> Health:
    return msgspec.structs.replace(EXAMPLES["health"], actor="child", pid=pid_of(process))


async def test_step_that_holds_the_gil_is_not_killed_before_its_timeout(tmp_path: Path) -> None:
    """The health message of the stage cannot be sent, so the parent process repeats it."""
    started, transport, healths = tmp_path / "started", MemoryTransport(), []
    program = [sys.executable, "-c", STEP.format(file=str(started), library="PyDLL")]
    process = ChildProcess("child", program, transport, silent_after_s=2.0, step_timeout_s=6.0)
    transport.subscribe("health/child", lambda _, body: healths.append(decode(body, Health)))
    async with running(process):
        await eventually(started.exists)
        transport.publisher("health/child").post(b"", encode(health_of(process)))
        await eventually(lambda: healths[-1].current_step_s > 4.0)
        assert process.restarts == 0
        assert healths[-1].state == "busy"
        await eventually(lambda: process.restarts == 1)


async def test_suspended_process_is_not_killed_before_its_timeout(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    started, transport = tmp_path / "started", MemoryTransport()
    program = [sys.executable, "-c", STEP.format(file=str(started), library="CDLL")]
    process = ChildProcess("child", program, transport, silent_after_s=0.5, step_timeout_s=1000)
    async with running(process):
        await eventually(started.exists)
        os.kill(pid_of(process), signal.SIGSTOP)
        await eventually(lambda: "is suspended" in caplog.text)
        transport.publisher("health/child").post(b"", encode(health_of(process)))
        await asyncio.sleep(1.5)  # Three times the heartbeat timeout.
        assert process.restarts == 0
        process.kill()
        await eventually(lambda: process.restarts == 1)


def test_child_process_ignores_packages_in_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "foreign.py").write_text("print('this ran')")
    command = ["foreign" if word == "ldo_service" else word for word in python_command()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert "No module named foreign" in done.stderr
    assert done.stdout == ""


async def test_child_is_not_killed_for_time_in_which_its_parent_did_not_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    killed: list[float] = []
    process = ChildProcess("actor", ["true"], MemoryTransport(), silent_after_s=10)
    monkeypatch.setattr(process, "kill", lambda: killed.append(now_s))
    loop = asyncio.get_running_loop()
    process._loop, process._heard_until_s = loop, 10.0
    now_s, steps_s = 0.0, iter([1.0] * 5 + [60.0] + [1.0] * 8)

    async def sleep(_period_s: float) -> None:
        """Advance the clock instead of waiting; a step of 60 s stands for a frozen process."""
        nonlocal now_s
        now_s += next(steps_s)

    monkeypatch.setattr(loop, "time", lambda: now_s)
    monkeypatch.setattr(asyncio, "sleep", sleep)
    with pytest.raises(RuntimeError, match="StopIteration"):
        await process._kill_when_silent()
    assert killed == [70.0], "10 s without a heartbeat, and a pause of 59 s"


async def test_cancelled_child_process_has_ended() -> None:
    sleeping = child("import time; time.sleep(1e6)")
    async with running(sleeping):
        await eventually(lambda: sleeping.pid is not None)
    with pytest.raises(ProcessLookupError):
        os.kill(pid_of(sleeping), 0)


async def test_child_drained_during_its_start_ends() -> None:
    sleeping = child("import time; time.sleep(1e6)")
    task = asyncio.create_task(sleeping.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    sleeping.drain()
    await asyncio.wait_for(task, 60)
    assert sleeping.restarts == 0


async def test_process_exits_after_its_parent_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PARENT_VARIABLE, "12345")
    monkeypatch.setattr(os, "getppid", lambda: 12345)
    waiting = asyncio.create_task(exit_with_parent(0.001))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    monkeypatch.setattr(os, "getppid", lambda: 1)
    await asyncio.wait_for(waiting, 60)


async def test_process_without_parent_variable_keeps_running(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(PARENT_VARIABLE, raising=False)
    waiting = asyncio.create_task(exit_with_parent(0.001))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    waiting.cancel()


def test_child_process_ends_after_its_parent_is_killed(network: Endpoint, tmp_path: Path) -> None:
    """The child detects the end of its parent, drains and exits."""
    numbers = tmp_path / "numbers"
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, *command(network, numbers)], stdout=subprocess.PIPE
    )
    assert parent.stdout
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    deadline_s = time.monotonic() + 60
    while is_running(pid):
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


PARENT = """
import os, subprocess, sys, time
child = subprocess.Popen(sys.argv[1:], env={**os.environ, "LDO_PARENT_PID": str(os.getpid())})
print(child.pid, flush=True)
time.sleep(1e6)
"""


def is_running(pid: int) -> bool:
    try:
        return " Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


@pytest.mark.skipif(
    not platform.libc_ver()[0].startswith("glibc"), reason="needs the malloc of glibc"
)
def test_trim_memory_returns_freed_memory_to_the_system() -> None:
    blocks = [bytearray(60_000) for _ in range(2000)]
    kept = blocks[::20]  # The kept blocks lie between the freed ones.
    del blocks
    before_mb = resident_mb()
    trim_memory()
    assert resident_mb() < before_mb - 60
    assert len(kept) == 100
