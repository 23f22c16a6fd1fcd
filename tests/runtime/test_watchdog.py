"""Tests of the notifications to systemd: the service is ready and its event loop runs."""

import asyncio
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ldo_service.runtime.supervision import Watchdog

from .fake_actors import eventually


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        yield listening


def received(systemd: socket.socket) -> list[bytes]:
    messages = []
    while True:
        try:
            messages.append(systemd.recv(100))
        except BlockingIOError:
            return messages


def environment(systemd: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": systemd.getsockname(), **more}


async def test_watchdog_pings_only_while_the_event_loop_runs(
    systemd: socket.socket,
) -> None:
    watchdog = Watchdog(environment(systemd, WATCHDOG_USEC="30000", WATCHDOG_PID=str(os.getpid())))
    watchdog.notify("READY=1")
    pinging = asyncio.create_task(watchdog.ping())
    messages: list[bytes] = []
    await eventually(lambda: messages.extend(received(systemd)) or len(messages) > 3)
    assert (messages[0], set(messages[1:])) == (b"READY=1", {b"WATCHDOG=1"})
    time.sleep(3 * watchdog.period_s)
    assert received(systemd) == []
    await eventually(lambda: received(systemd))
    pinging.cancel()


@pytest.mark.parametrize(
    "more", [{}, {"WATCHDOG_USEC": "junk"}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}]
)
async def test_watchdog_without_valid_period_or_process_id_does_not_ping(
    systemd: socket.socket, more
) -> None:
    await asyncio.wait_for(Watchdog(environment(systemd, **more)).ping(), 60)
    assert received(systemd) == []


async def test_watchdog_without_systemd_does_nothing(tmp_path: Path) -> None:
    for variables in ({}, {"NOTIFY_SOCKET": str(tmp_path / "absent")}):
        Watchdog(variables).notify("READY=1")
        await asyncio.wait_for(Watchdog(variables).ping(), 60)


def test_notification_reaches_a_socket_in_the_abstract_namespace() -> None:
    name = f"ldo-test-{os.getpid()}-{time.monotonic_ns()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("\0" + name)
        Watchdog({"NOTIFY_SOCKET": "@" + name}).notify("STOPPING=1")
        assert listening.recv(100) == b"STOPPING=1"
