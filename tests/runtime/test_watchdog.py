"""systemd hears that the service is up, and that its loop turns."""

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


def heard(systemd: socket.socket) -> list[bytes]:
    words = []
    while True:
        try:
            words.append(systemd.recv(100))
        except BlockingIOError:
            return words


def environment(systemd: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": systemd.getsockname(), **more}


async def test_pings_come_while_the_loop_turns_and_not_while_it_hangs(
    systemd: socket.socket,
) -> None:
    watchdog = Watchdog(environment(systemd, WATCHDOG_USEC="30000", WATCHDOG_PID=str(os.getpid())))
    watchdog.notify("READY=1")
    pinging = asyncio.create_task(watchdog.ping())
    words: list[bytes] = []
    await eventually(lambda: words.extend(heard(systemd)) or len(words) > 3)
    assert (words[0], set(words[1:])) == (b"READY=1", {b"WATCHDOG=1"})
    time.sleep(3 * watchdog.period_s)
    assert heard(systemd) == []
    await eventually(lambda: heard(systemd))
    pinging.cancel()


@pytest.mark.parametrize(
    "more", [{}, {"WATCHDOG_USEC": "junk"}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}]
)
async def test_who_is_not_watched_does_not_ping(systemd: socket.socket, more) -> None:
    await asyncio.wait_for(Watchdog(environment(systemd, **more)).ping(), 60)
    assert heard(systemd) == []


async def test_without_systemd_nothing_happens(tmp_path: Path) -> None:
    for words in ({}, {"NOTIFY_SOCKET": str(tmp_path / "absent")}):
        Watchdog(words).notify("READY=1")
        await asyncio.wait_for(Watchdog(words).ping(), 60)


def test_a_socket_in_the_abstract_namespace_is_reached() -> None:
    name = f"ldo-test-{os.getpid()}-{time.monotonic_ns()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("\0" + name)
        Watchdog({"NOTIFY_SOCKET": "@" + name}).notify("STOPPING=1")
        assert listening.recv(100) == b"STOPPING=1"
