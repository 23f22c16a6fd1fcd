"""Actors in processes of their own, which get killed and stopped."""

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

import pytest
import zenoh

from ldo_service.errors import RestartsExhausted
from ldo_service.runtime.actor import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.process import (
    PARENT_VARIABLE,
    ChildProcess,
    exit_with_parent,
    resident_mb,
    trim_memory,
)
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.transport.interface import MemoryTransport
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport

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
    """Return the number of a process that was started: 0 would be the group of the tests."""
    assert process.pid
    return process.pid


async def test_a_killed_consumer_nobody_expects_releases_the_window(
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


async def test_a_killed_and_a_stopped_process_are_replaced_and_nothing_is_lost(
    network: Endpoint, client: Callable[[], zenoh.Session], tmp_path: Path
) -> None:
    numbers, transport = tmp_path / "numbers", ZenohTransport(client(), network)
    source = Outlet(Out(NUMBERS), "producer", 1, transport, ["collector"])
    process = ChildProcess(
        "collector",
        command(network, numbers, 0.01),
        transport,
        silent_after_s=1.0,
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
    assert (
        len(handled) - 60 <= 2 * process.restarts
    )  # a step under way is done again, and one not yet granted
    assert process.pid is not None
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)


async def test_a_process_that_keeps_dying_exhausts_its_restarts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    dying = child("import sys; sys.exit(3)", max_restarts=2)
    with pytest.raises(RestartsExhausted, match="child failed 3 times"):
        await dying.run()
    assert dying.restarts == 2
    assert "ended with exit code 3" in caplog.text


async def test_a_process_that_never_reports_is_started_again() -> None:
    silent = child("import time; time.sleep(1e6)", start_within_s=0.1, silent_after_s=0.1)
    async with running(silent):
        await eventually(lambda: silent.restarts >= 2)


async def test_a_cancelled_child_is_gone() -> None:
    sleeping = child("import time; time.sleep(1e6)")
    async with running(sleeping):
        await eventually(lambda: sleeping.pid is not None)
    with pytest.raises(ProcessLookupError):
        os.kill(pid_of(sleeping), 0)


async def test_a_child_that_is_drained_while_it_starts_ends() -> None:
    sleeping = child("import time; time.sleep(1e6)")
    task = asyncio.create_task(sleeping.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    sleeping.drain()
    await asyncio.wait_for(task, 60)
    assert sleeping.restarts == 0


async def test_a_process_leaves_when_its_parent_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PARENT_VARIABLE, "12345")
    monkeypatch.setattr(os, "getppid", lambda: 12345)
    waiting = asyncio.create_task(exit_with_parent(0.001))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    monkeypatch.setattr(os, "getppid", lambda: 1)
    await asyncio.wait_for(waiting, 60)


async def test_a_process_started_by_hand_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PARENT_VARIABLE, raising=False)
    waiting = asyncio.create_task(exit_with_parent(0.001))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    waiting.cancel()


def test_a_child_of_a_killed_parent_does_not_outlive_it(network: Endpoint, tmp_path: Path) -> None:
    """The whole chain: parent killed, child sees it, drains and goes."""
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
    not platform.libc_ver()[0].startswith("glibc"), reason="needs glibc: its malloc is meant"
)
def test_memory_that_was_let_go_goes_back_to_the_system() -> None:
    blocks = [bytearray(60_000) for _ in range(2000)]
    kept = blocks[::20]  # which lie between those that go
    del blocks
    before_mb = resident_mb()
    trim_memory()
    assert resident_mb() < before_mb - 60
    assert len(kept) == 100
