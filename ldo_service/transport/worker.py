"""Worker thread that runs jobs in order."""

import asyncio
import logging
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Lock, Thread, get_native_id
from typing import Any, ParamSpec, TypeVar
from weakref import WeakSet

log = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")


class Worker:
    """Daemon thread that runs jobs in order.

    Unlike a thread of `ThreadPoolExecutor`, this thread does not keep the interpreter from exiting
    while a job runs. The queue has no limit, so callers must bound the number of jobs.
    """

    _all: "WeakSet[Worker]" = WeakSet()

    def __init__(self, name: str, *, nice: int = 0) -> None:
        """Start the thread.

        Args:
            name: Name of the thread.
            nice: Increase of the thread's nice value, 0..19, on Linux. Threads that a job starts
                inherit the value. A larger value gives other threads priority on a busy machine.
        """
        self.name, self._nice = name, nice
        self._jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._lock = Lock()
        self._closed = False
        self._thread = Thread(target=self._work, name=name, daemon=True)
        self._thread.start()
        Worker._all.add(self)

    def submit(self, job: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> "Future[R]":
        """Queue a job, and return its future.

        After `close`, the job is not queued, and its future is cancelled.
        """
        future: Future[R] = Future()
        with self._lock:
            if self._closed:
                future.cancel()
            else:
                self._jobs.put((future, lambda: job(*args, **kwargs)))
        return future

    async def run(self, job: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run a job in the thread and wait for its result."""
        return await asyncio.wrap_future(self.submit(job, *args, **kwargs))

    def close(self) -> None:
        """Let the thread end after the jobs submitted so far; do not wait for its end."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._jobs.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` for the end of the thread; call `close` first.

        Without this wait, the end of the interpreter may kill the thread inside a library. Some
        libraries then abort the process.
        """
        self._thread.join(timeout_s)

    @classmethod
    def busy_workers(cls, within_s: float) -> list[str]:
        """Return the names of the closed workers whose threads still run after `within_s` seconds.

        The interpreter must not end while they run; see `join`.
        """
        until_s = time.monotonic() + within_s
        closed = [worker for worker in cls._all if worker._closed]
        for worker in closed:
            worker.join(max(0.0, until_s - time.monotonic()))
        return sorted(worker.name for worker in closed if worker._thread.is_alive())

    def _work(self) -> None:
        _lower_priority(self.name, self._nice)
        while entry := self._jobs.get():
            future, job = entry
            if future.set_running_or_notify_cancel():
                settle(future, job)
            del entry, future, job  # An idle thread must keep no references.


def _lower_priority(name: str, nice: int) -> None:
    """Increase the nice value of the calling thread; log a warning if a sandbox forbids it."""
    if not nice or sys.platform != "linux":
        return
    thread = get_native_id()
    try:
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + nice)
    except OSError as error:
        log.warning(
            "%s: cannot lower the thread priority (%s); this thread may delay tracking on a busy "
            "machine. Set supervision.background_nice=0 to silence this warning.",
            name, error.strerror,
        )  # fmt: skip


def settle(future: Future[Any], job: Callable[[], Any]) -> None:
    """Run a job, and give its result or its exception to a future."""
    try:
        result = job()
    except (StopIteration, GeneratorExit, KeyboardInterrupt, SystemExit) as error:
        # asyncio cannot pass on errors of this type, so the future gets a RuntimeError.
        failure = RuntimeError(f"{type(error).__name__} was raised")
        failure.__cause__ = error
        future.set_exception(failure)
    except BaseException as error:
        future.set_exception(error)
    else:
        future.set_result(result)
