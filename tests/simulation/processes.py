"""Simulated stand-ins for child processes and for the threads of actors."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from ldo_service.runtime.supervision import StopRequest
from ldo_service.transport.worker import settle

from .virtual_loop import Process, VirtualLoop, is_current_dead


class ChildHandle:
    """Handle of a child process, with what `ChildProcess` uses of `asyncio.subprocess.Process`."""

    def __init__(self, process: Process, stop: StopRequest) -> None:
        self._process, self._stop = process, stop
        self.pid = process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code; None while the process runs."""
        return self._process.exit_code

    async def wait(self) -> int:
        """Wait for the end of the process, and return its exit code."""
        await self._process.ended.wait()
        assert self._process.exit_code is not None
        return self._process.exit_code

    def terminate(self) -> None:
        """Request a soft stop (SIGTERM)."""
        self._stop.request()

    def kill(self) -> None:
        """Kill the process (SIGKILL)."""
        self._process.kill()


class NoPipe:
    """Heartbeat pipe of a child process that never holds the interpreter's lock."""

    writer = -1

    def __init__(self, on_beat: Callable[[float], None]) -> None:
        pass

    def close_writer(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class SimulatedWorker:
    """Thread of an actor; each job runs after a random delay, as a callback of the event loop."""

    def __init__(self, loop: VirtualLoop, duration_s: Callable[[], float]) -> None:
        """Start without jobs.

        Args:
            loop: The event loop of all processes.
            duration_s: Function that returns the duration of the next job, seconds.
        """
        self._loop, self._duration_s = loop, duration_s
        self._free_at_s = 0.0
        self._is_closed = False

    def submit(self, job: Callable[..., Any], *args: Any) -> "Future[Any]":
        """Queue a job, and return its future."""
        future: Future[Any] = Future()
        if self._is_closed or is_current_dead():
            future.cancel()
            return future

        def work() -> None:
            if not is_current_dead() and future.set_running_or_notify_cancel():
                settle(future, lambda: job(*args))

        start_s = max(self._free_at_s, self._loop.time())
        self._free_at_s = start_s + self._duration_s()
        self._loop.call_at(self._free_at_s, work)
        return future

    async def run(self, job: Callable[..., Any], *args: Any) -> Any:
        """Run a job, and wait for its result."""
        return await asyncio.wrap_future(self.submit(job, *args))

    def close(self) -> None:
        """Take no more jobs."""
        self._is_closed = True
