"""An actor in a process of its own, seen from the process that started it."""

import asyncio
import logging
import os
import resource
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from ldo_service.errors import RestartsExhausted

from .transport import Transport

log = logging.getLogger(__name__)

PARENT_VARIABLE = "LDO_PARENT_PID"  # a child whose parent is gone has nobody to serve, and leaves


def resident_mb() -> float:
    """Memory of this process in RAM now, in MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not Linux: the peak is all that can be had
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 1e6


async def leave_with_parent(period_s: float = 0.5) -> None:
    """Return when the process that started this one is gone; at once never, without a parent."""
    parent = int(os.environ.get(PARENT_VARIABLE, "0"))
    while parent == 0 or os.getppid() == parent:
        await asyncio.sleep(period_s)
    log.warning("the process that started this one is gone")


class ChildProcess:
    """Starts an actor's process, and starts it again when it dies or is silent.

    `command` must run the stage `name` and end with exit code 0 after SIGTERM.
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
    ) -> None:
        self.name = name
        self._command, self._transport = command, transport
        self._environment = {**os.environ, **(environment or {}), PARENT_VARIABLE: str(os.getpid())}
        self._max_restarts, self._window_s = max_restarts, restart_window_s
        self._delay_s, self._silent_after_s = restart_delay_s, silent_after_s
        self._died_at_s: deque[float] = deque()
        self._process: asyncio.subprocess.Process | None = None
        self._draining = False
        self._heard_at_s: float | None = None  # None until the first heartbeat of a process
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
                self._heard_at_s = None
                self._process = await asyncio.create_subprocess_exec(
                    *self._command, env=self._environment
                )
                log.info("%s runs in process %d", self.name, self._process.pid)
                code = await self._process.wait()
                if not self._draining:
                    await self._back_off(code)
        finally:
            watch.cancel()
            self._kill()

    def drain(self) -> None:
        """Soft stop."""
        self._draining = True
        if self._process and self._process.returncode is None:
            self._process.terminate()

    def kill(self) -> None:
        """End the process now; it is started again."""
        self._kill()

    def _kill(self) -> None:
        if self._process and self._process.returncode is None:
            self._process.kill()

    def _heard(self) -> None:
        self._heard_at_s = self._loop.time()

    async def _kill_when_silent(self) -> None:
        """A stopped process keeps its connection for seconds: only its silence tells."""
        while True:
            await asyncio.sleep(self._silent_after_s / 10)
            heard_at_s = self._heard_at_s
            if heard_at_s is not None and self._loop.time() - heard_at_s > self._silent_after_s:
                log.error("%s has been silent for %.0f s: killed", self.name, self._silent_after_s)
                self._heard_at_s = None
                self._kill()

    async def _back_off(self, code: int) -> None:
        now = self._loop.time()
        self._died_at_s.append(now)
        while self._died_at_s[0] < now - self._window_s:
            self._died_at_s.popleft()
        recent = len(self._died_at_s)
        how = f"killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        if recent > self._max_restarts:
            log.error("%s: its process was %s", self.name, how)
            raise RestartsExhausted(self.name, recent, self._window_s)
        log.error("%s: its process was %s; started again", self.name, how)
        self.restarts += 1
        await asyncio.sleep(self._delay_s * 2 ** (recent - 1))


def python_command(*arguments: str) -> list[str]:
    """The command line of this very installation."""
    return [sys.executable, "-m", "ldo_service", *arguments]
