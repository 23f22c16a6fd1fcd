"""All stages of a process in one task group, and the watchdog of systemd.

An error that a stage gives up on ends them all. The protocol of the watchdog is that of
sd_notify(3): a word in a datagram to the socket that the environment names. A unit with
`WatchdogSec=` restarts a service whose event loop stood still for so long.
"""

import asyncio
import logging
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Protocol

log = logging.getLogger(__name__)

PINGS_PER_PERIOD = 3  # sd_watchdog_enabled(3) asks for two; one may come late on a busy machine


class Runner(Protocol):
    """A stage in this process, or the process of one."""

    name: str

    async def run(self) -> None: ...

    def drain(self) -> None: ...


class StopRequest:
    """Asked once: soft, each stage finishes what it has. Asked twice: hard, at once."""

    def __init__(self) -> None:
        self._soft, self._hard = asyncio.Event(), asyncio.Event()

    def request(self) -> None:
        (self._hard if self._soft.is_set() else self._soft).set()

    @property
    def is_asked(self) -> bool:
        return self._soft.is_set()

    async def wait_soft(self) -> None:
        await self._soft.wait()

    async def wait_hard(self) -> None:
        await self._hard.wait()


async def supervise(runners: Sequence[Runner], stop: StopRequest, drain_s: float = 10.0) -> None:
    """Run until asked to stop; then end them in the given order, producers first.

    Raises what a runner gave up on (RestartsExhausted, StageStalled).
    """
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(runner.run(), name=runner.name) for runner in runners]
            await stop.wait_soft()
            hard = asyncio.create_task(stop.wait_hard())
            try:
                for runner, task in zip(runners, tasks, strict=True):
                    await _end(runner, task, hard, drain_s)
            finally:
                hard.cancel()
    except BaseExceptionGroup as errors:
        raise _first(errors) from None


async def _end(
    runner: Runner, task: asyncio.Task[None], hard: asyncio.Task[None], drain_s: float
) -> None:
    if not hard.done():
        runner.drain()
        await asyncio.wait({task, hard}, timeout=drain_s, return_when=asyncio.FIRST_COMPLETED)
    if not task.done():
        log.warning("%s did not end in time: cancelled", runner.name)
        task.cancel()


def _first(errors: BaseExceptionGroup) -> BaseException:
    """The error that ended the group; the others followed from it."""
    error: BaseException = errors
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


class Watchdog:
    """Says nothing where nobody listens."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = environment.get("WATCHDOG_USEC", "") if watched else ""
        self.period_s = int(period) * 1e-6 if period.isdecimal() else 0.0  # 0: not watched

    def notify(self, word: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, suppress(OSError):
            notify.setblocking(False)
            notify.sendto(word.encode(), self._address)

    async def ping(self) -> None:
        """For ever, on the event loop that is watched; returns at once when nobody does."""
        while self.period_s > 0:
            self.notify("WATCHDOG=1")
            await asyncio.sleep(self.period_s / PINGS_PER_PERIOD)
