"""Supervision of all stages of a process in one task group, and the watchdog of systemd.

If a stage cannot recover from an error, all stages end. `Watchdog` uses the protocol of
sd_notify(3): it sends short text datagrams to the socket that the variable NOTIFY_SOCKET names. The
systemd unit of the service may set a time by `WatchdogSec=`. If the event loop is blocked for this
time, systemd restarts the service.
"""

import asyncio
import logging
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Protocol

from ldo_service.schemas import Health

log = logging.getLogger(__name__)

# Time without work after which the actors count as quiet, seconds: two heartbeat periods of a child
# process.
QUIET_S = 1.0

# Time that all runners together have for a soft stop, and that each has at least, as multiples of
# `drain_s`. Seven actors and the default of 10 s then need at most 22 s; the unit of systemd allows
# 30 s.
ALL_DRAIN = 1.5
MIN_DRAIN = 0.1

# Notifications per watchdog period. sd_watchdog_enabled(3) recommends two. With three, one may be
# late on a busy machine.
PINGS_PER_PERIOD = 3


class Runner(Protocol):
    """Interface of a stage that runs in this process or in a child process."""

    name: str

    async def run(self) -> None: ...

    def drain(self) -> None: ...

    def health(self) -> Health | None: ...


class StopRequest:
    """Stop request: soft after the first call of `request`, hard after the second.

    On a soft stop, each stage handles its queued messages and ends. A hard stop cancels the stages.
    """

    def __init__(self) -> None:
        self._soft, self._hard = asyncio.Event(), asyncio.Event()

    def request(self) -> None:
        """Request a soft stop, or a hard stop if a soft stop is already requested."""
        (self._hard if self._soft.is_set() else self._soft).set()

    async def wait_soft(self) -> None:
        """Wait for the first call of `request`, which requests a soft stop."""
        await self._soft.wait()

    async def wait_hard(self) -> None:
        """Wait for the second call of `request`, which requests a hard stop."""
        await self._hard.wait()


async def wait_until_quiet(runners: Sequence[Runner], timeout_s: float) -> None:
    """Wait until all runners have been idle for `QUIET_S` seconds, or until `timeout_s` has passed.

    A runner is idle if it has no queued message and no running step. After `QUIET_S` seconds, no
    message is on its way between two runners.

    Args:
        runners: Stages and child processes.
        timeout_s: Maximum time to wait, seconds.
    """
    loop = asyncio.get_running_loop()
    until_s, quiet_since_s = loop.time() + timeout_s, loop.time()
    while (now_s := loop.time()) < until_s and now_s - quiet_since_s < QUIET_S:
        healths = [runner.health() for runner in runners]
        if any(h and (h.current_step_s or any(i.queued for i in h.inputs)) for h in healths):
            quiet_since_s = now_s
        await asyncio.sleep(QUIET_S / 20)


async def supervise(
    runners: Sequence[Runner], stop: StopRequest, drain_s: float = 10.0, sources: int = 0
) -> None:
    """Run the stages until a stop request, then end them in the given order.

    Args:
        runners: Stages and child processes, producers first.
        stop: The stop request.
        sources: Number of sources: runners that get their inputs from outside the service. They
            come first in `runners` and end first. The other runners then have up to `drain_s`
            seconds to handle the last outputs of the sources and all messages that follow.
        drain_s: Time that each runner has for a soft stop before it is cancelled, seconds. All
            runners together have `ALL_DRAIN * drain_s` seconds. After this time, each remaining
            runner has `MIN_DRAIN * drain_s` seconds.

    Raises:
        RestartsExhausted: An actor has used up its restart budget.
        StageStalled: A step took longer than `SupervisionConfig.step_limit` allows.
    """
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(runner.run(), name=runner.name) for runner in runners]
            await stop.wait_soft()
            hard = asyncio.create_task(stop.wait_hard())
            loop = asyncio.get_running_loop()
            until_s = loop.time() + ALL_DRAIN * drain_s

            def remaining_s() -> float:
                return min(drain_s, max(until_s - loop.time(), MIN_DRAIN * drain_s))

            try:
                for number, (runner, task) in enumerate(zip(runners, tasks, strict=True), 1):
                    await _end(runner, task, hard, remaining_s())
                    if number == sources:
                        quiet = asyncio.create_task(
                            wait_until_quiet(runners[number:], remaining_s())
                        )
                        await asyncio.wait({quiet, hard}, return_when=asyncio.FIRST_COMPLETED)
                        quiet.cancel()
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
        log.warning("%s: did not stop in time and is cancelled.", runner.name)
        task.cancel()


def _first(errors: BaseExceptionGroup) -> BaseException:
    """Return the first error of the group; the other errors are its consequences."""
    error: BaseException = errors
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


class Watchdog:
    """Client of the systemd watchdog; it does nothing without systemd."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        period = environment.get("WATCHDOG_USEC", "") if watched else ""
        self.period_s = int(period) * 1e-6 if period.isdecimal() else 0.0  # 0: no watchdog.

    def notify(self, word: str) -> None:
        """Send a notification of the sd_notify(3) protocol, for example "READY=1"."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify, suppress(OSError):
            notify.setblocking(False)
            notify.sendto(word.encode(), self._address)

    async def ping(self) -> None:
        """Notify the watchdog periodically; return immediately if systemd has set no watchdog."""
        while self.period_s > 0:
            self.notify("WATCHDOG=1")
            await asyncio.sleep(self.period_s / PINGS_PER_PERIOD)
