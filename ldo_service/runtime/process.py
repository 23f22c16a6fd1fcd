"""An actor in a process of its own, seen from the process that started it."""

import asyncio
import ctypes
import logging
import os
import resource
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from ldo_service.transport.interface import Transport

from .supervision_policy import RestartBudget

log = logging.getLogger(__name__)

PARENT_VARIABLE = "LDO_PARENT_PID"  # a child whose parent is gone has nobody to serve, and leaves


def resident_mb() -> float:
    """Memory of this process in RAM now, in MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not Linux: the peak is all that can be had
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 1e6


def trim_memory() -> None:
    """Hand the system what this process let go of. Without it glibc keeps what lies between what is
    still used: 280 MB after three laps of a flat. Elsewhere than on Linux nothing is done."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


async def exit_with_parent(period_s: float = 0.5) -> None:
    """Return when the process that started this one is gone; never, if no ChildProcess did."""
    parent = int(os.environ.get(PARENT_VARIABLE, "0"))
    while parent == 0 or os.getppid() == parent:
        await asyncio.sleep(period_s)
    log.warning("the process that started this one is gone")


class ChildProcess:
    """Starts an actor's process, and starts it again when it dies or is silent.

    `command` must run the stage `name` and end after SIGTERM. It gets a process group of its own:
    Ctrl-C at a terminal reaches the parent alone, which ends its children in order.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        transport: Transport,
        *,
        environment: Mapping[str, str] | None = None,
        max_restarts: int = 5,
        restart_window_s: float = 60.0,
        restart_delay_s: float = 0.05,
        silent_after_s: float = 10.0,
        start_within_s: float = 60.0,
    ) -> None:
        self.name = name
        self._command, self._transport = command, transport
        self._environment = {**os.environ, **(environment or {}), PARENT_VARIABLE: str(os.getpid())}
        self._budget = RestartBudget(
            name, max_restarts, restart_window_s, restart_delay_s, delay_max_s=5.0
        )
        self._silent_after_s, self._start_within_s = silent_after_s, start_within_s
        self._process: asyncio.subprocess.Process | None = None
        self._draining = False
        self._heard_until_s = float("inf")  # a heartbeat must come before
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    async def run(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._transport.subscribe(f"health/{self.name}", lambda _header, _body: self._heard())
        watch = asyncio.create_task(self._kill_when_silent(), name=f"{self.name} watch")
        try:
            while not self._draining:
                code = await self._run_once()
                if not self._draining:
                    await self._back_off(code)
        finally:
            watch.cancel()
            self.kill()
            if self._process:
                await self._process.wait()

    async def _run_once(self) -> int:
        """Exit code of one process; negative: the signal that killed it."""
        self._process = await asyncio.create_subprocess_exec(
            *self._command, env=self._environment, process_group=0
        )
        log.info("%s runs in process %d", self.name, self._process.pid)
        self._heard_until_s = self._loop.time() + self._start_within_s
        if self._draining:  # asked while it was being started
            self._process.terminate()
        return await self._process.wait()

    def drain(self) -> None:
        """Soft stop."""
        self._draining = True
        if self._process and self._process.returncode is None:
            self._process.terminate()

    def kill(self) -> None:
        """End the process now; it is started again."""
        if self._process and self._process.returncode is None:
            self._process.kill()

    def _heard(self) -> None:
        self._heard_until_s = self._loop.time() + self._silent_after_s

    async def _kill_when_silent(self) -> None:
        """A stopped process keeps its connection for seconds: only its silence tells."""
        while True:
            await asyncio.sleep(self._silent_after_s / 10)
            if self._loop.time() > self._heard_until_s:
                log.error("%s is silent: its process %s is killed", self.name, self.pid)
                self._heard_until_s = float("inf")
                self.kill()

    async def _back_off(self, code: int) -> None:
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        log.error("%s: its process %s", self.name, how)
        await asyncio.sleep(self._budget.record_failure(self._loop.time()))
        self.restarts += 1


def python_command(*arguments: str) -> list[str]:
    """The command line of this very installation."""
    return [sys.executable, "-m", "ldo_service", *arguments]
