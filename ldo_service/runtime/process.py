"""Child processes for actors, which the main process starts and watches."""

import asyncio
import ctypes
import logging
import os
import resource
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import msgspec

from ldo_service.schemas import Health, decode, encode
from ldo_service.schemas.topics import HEALTH
from ldo_service.transport.flow_control import Header, encode_link
from ldo_service.transport.interface import Transport, call_soon

from .process_heartbeat import PIPE_VARIABLE, HeartbeatPipe
from .supervision_policy import RestartBudget, RunningClock

log = logging.getLogger(__name__)

# Time without a health message after which the parent process repeats the last one, seconds: three
# heartbeat periods.
REPEAT_HEALTH_AFTER_S = 1.5
PARENT_VARIABLE = "LDO_PARENT_PID"  # A child ends when its parent process has ended.


def resident_mb() -> float:
    """Return the resident memory of this process, MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # Other systems than Linux report only the peak.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 1e6


def available_memory_mb() -> float | None:
    """Return the memory that this machine can still give to programs, MB; None if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:  # Other systems than Linux have no such file.
        return None
    return next((int(x.split()[1]) / 1e3 for x in lines if x.startswith("MemAvailable:")), None)


def trim_memory() -> None:
    """Give freed memory back to the operating system.

    The allocator of glibc does not return free memory that lies between blocks in use. After three
    laps through the sequence `synthetic:flat`, 280 MB were not returned. On systems other than
    Linux, the function does nothing.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def raise_file_limit() -> None:
    """Raise the soft limit of open files of this process to the hard limit.

    systemd and shells set a soft limit of 1024, because `select` cannot handle more files. This
    program does not use `select`.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


async def exit_with_parent(period_s: float = 0.5) -> None:
    """Wait until the parent process has ended; the caller then ends this process.

    The function waits forever if no `ChildProcess` started this process.

    Args:
        period_s: Time between two checks, seconds.
    """
    parent = int(os.environ.get(PARENT_VARIABLE, "0"))
    while parent == 0 or os.getppid() == parent:
        await asyncio.sleep(period_s)
    log.warning("The parent process has ended; this process stops too.")


class ChildProcess:
    """Child process of one actor; it is restarted if it exits or sends no heartbeat in time.

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
        step_timeout_s: float = 600.0,
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
            step_timeout_s: Maximum duration of a step, seconds. A process that is suspended
                (SIGSTOP, a debugger) sends no heartbeats and is killed after the same time.
        """
        self.name = name
        self._command, self._transport = command, transport
        self._environment = {**os.environ, **(environment or {}), PARENT_VARIABLE: str(os.getpid())}
        self._budget = RestartBudget(
            name, max_restarts, restart_window_s, restart_delay_s, delay_max_s=5.0
        )
        self._silent_after_s, self._start_within_s = silent_after_s, start_within_s
        self._step_timeout_s = step_timeout_s
        self._health: Health | None = None  # Last health message of the process.
        self._health_at_s = 0.0  # Event-loop time at which it arrived.
        self._suspended_at_s: float | None = None  # Event-loop time of a suspension.
        self._process: asyncio.subprocess.Process | None = None
        self._draining = False
        self._heard_until_s = float("inf")  # Deadline of the next heartbeat.
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """Process id of the process started last; None before the first start."""
        return self._process.pid if self._process else None

    async def run(self) -> None:
        """Start the process, and restart it whenever it ends, until `drain` is called.

        Raises:
            RestartsExhausted: The restart budget is used up.
        """
        self._loop = asyncio.get_running_loop()
        key = f"{HEALTH.name}/{self.name}"
        self._own_health = self._transport.publisher(key)
        self._transport.subscribe(key, self._on_health)
        watch = asyncio.create_task(self._kill_when_silent(), name=f"{self.name} watch")
        try:
            while not self._draining:
                how = await self._run_once()
                if not self._draining:
                    await self._back_off(how)
        finally:
            watch.cancel()
            self.kill()
            if self._process:
                await self._process.wait()
            self._own_health.close()

    async def _run_once(self) -> str:
        """Run one process, and return how it ended, for the log."""
        try:
            code = await self._run_process()
        except OSError as error:  # The machine may lack memory or file descriptors for a while.
            return f"cannot be started: {error.strerror or error}"
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"

    async def _run_process(self) -> int:
        """Run one process and return its exit code.

        A negative code is the number of the signal that killed the process.

        Raises:
            OSError: The process cannot be started.
        """
        pipe = HeartbeatPipe(self._on_beat)
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._command,
                env={**self._environment, PIPE_VARIABLE: str(pipe.writer)},
                pass_fds=(pipe.writer,),
                process_group=0,
            )
            pipe.close_writer()
            log.info("%s: started process %d.", self.name, self._process.pid)
            self._health, self._suspended_at_s = None, None
            self._heard_until_s = self._loop.time() + self._start_within_s
            if self._draining:  # `drain` was called while the process started.
                self._process.terminate()
            return await self._process.wait()
        finally:
            pipe.close()

    def drain(self) -> None:
        """Request a soft stop: the process handles its queued messages and ends."""
        self._draining = True
        if self._process and self._process.returncode is None:
            self._process.terminate()

    def health(self) -> Health | None:
        """Return the last health message of the process; None before the first one."""
        return self._health

    def kill(self) -> None:
        """Kill the process now; `run` restarts it."""
        if self._process and self._process.returncode is None:
            self._process.kill()

    # --- heartbeats -------------------------------------------------------------------------
    def _on_health(self, _header: bytes, body: memoryview) -> None:
        """Take a health message of the process, on any thread."""
        with suppress(msgspec.DecodeError):
            call_soon(self._loop, self._take_health, decode(body, Health))

    def _take_health(self, health: Health) -> None:
        """Store a health message, and extend the deadline of the next heartbeat.

        Messages that the parent process has repeated itself are ignored; see `_on_beat`.
        """
        is_repeated = self._health is not None and health.step_age_s == self._health.step_age_s
        if health.pid == self.pid and not is_repeated:
            self._health, self._health_at_s = health, self._loop.time()
            self._heard_until_s = self._health_at_s + self._silent_after_s

    def _on_beat(self, step_age_s: float) -> None:
        """Extend the deadline of the next heartbeat during a step, which may hold the GIL.

        The stage cannot send health messages while a step holds the GIL. The parent process then
        repeats the last one with the age of the step. Between steps, the health messages must come
        from the stage itself.

        Args:
            step_age_s: Time since the start of the current step, seconds; 0 between steps.
        """
        if not 0.0 < step_age_s <= self._step_timeout_s:
            return
        now_s = self._loop.time()
        self._heard_until_s = max(self._heard_until_s, now_s + self._silent_after_s)
        if self._health is not None and now_s - self._health_at_s > REPEAT_HEALTH_AFTER_S:
            health = msgspec.structs.replace(self._health, state="busy", current_step_s=step_age_s)
            self._health = health  # `step_age_s` still marks it as repeated.
            header = Header(self.name, health.epoch, 0, health.stamp_ns)
            self._own_health.post(encode_link(header), encode(health))

    async def _kill_when_silent(self) -> None:
        """Kill the process when its heartbeat timeout expires.

        A process that the user suspended (SIGSTOP, a debugger) is killed only when its step timeout
        has expired too.
        """
        clock, period_s = RunningClock(self._loop.time), self._silent_after_s / 10
        clock.tick(period_s)
        while True:
            await asyncio.sleep(period_s)
            # This process cannot receive heartbeats of the child while it does not run itself.
            self._heard_until_s += clock.tick(period_s)
            now_s = self._loop.time()
            if self.pid is not None and _is_suspended(self.pid):
                if self._suspended_at_s is None:
                    self._suspended_at_s = now_s
                    log.warning(
                        "%s: its process %d is suspended, and is killed after %.0f s, the step "
                        "timeout. Resume the process with `kill -CONT %d`.",
                        self.name, self.pid, self._step_timeout_s, self.pid,
                    )  # fmt: skip
                if now_s - self._suspended_at_s < self._step_timeout_s:
                    self._heard_until_s = now_s + self._silent_after_s
            else:
                self._suspended_at_s = None
            if now_s > self._heard_until_s:
                log.error("%s: no heartbeat in time; killing its process %s.", self.name, self.pid)
                self._heard_until_s = float("inf")
                self.kill()

    async def _back_off(self, how: str) -> None:
        log.error("%s: its process %s; restarting it within its restart budget.", self.name, how)
        await asyncio.sleep(self._budget.record_failure(self._loop.time()))
        self.restarts += 1


def _is_suspended(pid: int) -> bool:
    """Return whether a process is stopped by a signal or a debugger; False if that is unknown."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # Other systems than Linux, or the process has ended.
        return False
    return state in "Tt"


def python_command(*arguments: str) -> list[str]:
    """Return the command line that runs this installation of `ldo` with the given arguments.

    The option `-P` keeps Python from importing a package `ldo_service` in the current folder.
    """
    return [sys.executable, "-P", "-m", "ldo_service", *arguments]
