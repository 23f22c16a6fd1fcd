"""Child processes: actors that run in processes of their own, handled by the parent process."""

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

PARENT_VARIABLE = "LDO_PARENT_PID"  # A child ends when its parent process has ended.


def resident_mb() -> float:
    """Return the resident memory of this process, MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # Other systems than Linux report only the peak.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 1e6


def trim_memory() -> None:
    """Return freed memory to the operating system.

    Otherwise glibc keeps free memory between blocks in use. This was 280 MB after a camera walk of
    three laps through the synthetic flat. On other systems than Linux the function does nothing.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


async def exit_with_parent(period_s: float = 0.5) -> None:
    """Wait until the parent process has ended.

    The function waits forever if no `ChildProcess` started this process.

    Args:
        period_s: Time between two checks, seconds.
    """
    parent = int(os.environ.get(PARENT_VARIABLE, "0"))
    while parent == 0 or os.getppid() == parent:
        await asyncio.sleep(period_s)
    log.warning("The parent process has ended; this process stops too.")


class ChildProcess:
    """Process of one actor; it is restarted when it exits or sends no heartbeat in time.

    The process has a process group of its own. Ctrl-C at a terminal therefore reaches only the
    parent, which ends its children in order.
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
        """Prepare the process; `run` starts it.

        Args:
            name: Name of the actor.
            command: Command line that runs the stage `name` and ends after SIGTERM.
            transport: The network, for heartbeats.
            environment: Additional environment variables.
            max_restarts: Maximum number of restarts within `restart_window_s`.
            restart_window_s: Time window of the restart budget, seconds.
            restart_delay_s: Delay before a restart, seconds. It doubles with each failure in the
                window.
            silent_after_s: Maximum time between heartbeats, seconds; then the process is killed.
            start_within_s: Maximum time from the start to the first heartbeat, seconds.
        """
        self.name = name
        self._command, self._transport = command, transport
        self._environment = {**os.environ, **(environment or {}), PARENT_VARIABLE: str(os.getpid())}
        self._budget = RestartBudget(
            name, max_restarts, restart_window_s, restart_delay_s, delay_max_s=5.0
        )
        self._silent_after_s, self._start_within_s = silent_after_s, start_within_s
        self._process: asyncio.subprocess.Process | None = None
        self._draining = False
        self._heard_until_s = float("inf")  # Deadline of the next heartbeat.
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """Process id of the last started process."""
        return self._process.pid if self._process else None

    async def run(self) -> None:
        """Start the process, and restart it until `drain`.

        Raises:
            RestartsExhausted: The restart budget is used up.
        """
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
        """Run one process and return its exit code.

        A negative code is the number of the signal that killed the process.
        """
        self._process = await asyncio.create_subprocess_exec(
            *self._command, env=self._environment, process_group=0
        )
        log.info("%s: started process %d.", self.name, self._process.pid)
        self._heard_until_s = self._loop.time() + self._start_within_s
        if self._draining:  # `drain` was called while the process started.
            self._process.terminate()
        return await self._process.wait()

    def drain(self) -> None:
        """Request a soft stop."""
        self._draining = True
        if self._process and self._process.returncode is None:
            self._process.terminate()

    def kill(self) -> None:
        """Kill the process now; `run` restarts it."""
        if self._process and self._process.returncode is None:
            self._process.kill()

    def _heard(self) -> None:
        self._heard_until_s = self._loop.time() + self._silent_after_s

    async def _kill_when_silent(self) -> None:
        """Kill the process when its heartbeat timeout expires.

        A suspended process keeps its network connection for seconds, so only the timeout detects it
        in time.
        """
        while True:
            await asyncio.sleep(self._silent_after_s / 10)
            if self._loop.time() > self._heard_until_s:
                log.error("%s: no heartbeat in time; killing its process %s.", self.name, self.pid)
                self._heard_until_s = float("inf")
                self.kill()

    async def _back_off(self, code: int) -> None:
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        log.error("%s: its process %s; restarting it within its restart budget.", self.name, how)
        await asyncio.sleep(self._budget.record_failure(self._loop.time()))
        self.restarts += 1


def python_command(*arguments: str) -> list[str]:
    """Return the command line of this installation with the given arguments."""
    return [sys.executable, "-m", "ldo_service", *arguments]
