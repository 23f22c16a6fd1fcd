"""A thread that works off what it is given, in order."""

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
    """One daemon thread.

    An executor's thread keeps the interpreter from exiting while a job runs, for ever if the job
    never ends; this one does not. How much may wait is up to who submits. `nice` of 0..19: so much
    it steps back behind other threads where there are too few cores; on Linux, where each thread
    may, and those that it starts do as it does.
    """

    _all: "WeakSet[Worker]" = WeakSet()

    def __init__(self, name: str, *, nice: int = 0) -> None:
        self.name, self._nice = name, nice
        self._jobs: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._lock = Lock()
        self._closed = False
        self._thread = Thread(target=self._work, name=name, daemon=True)
        self._thread.start()
        Worker._all.add(self)

    def submit(self, job: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> "Future[R]":
        """Run soon, in the thread. After `close` the future is cancelled at once."""
        future: Future[R] = Future()
        with self._lock:
            if self._closed:
                future.cancel()
            else:
                self._jobs.put((future, lambda: job(*args, **kwargs)))
        return future

    async def run(self, job: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        return await asyncio.wrap_future(self.submit(job, *args, **kwargs))

    def close(self) -> None:
        """End after what was submitted so far; nobody waits for it."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._jobs.put(None)

    def join(self, timeout_s: float) -> None:
        """Wait for the thread after `close`: one that is inside a library while the interpreter
        ends would be killed there, which some libraries answer with an abort."""
        self._thread.join(timeout_s)

    @classmethod
    def busy_workers(cls, within_s: float) -> list[str]:
        """Names of closed ones that are still at work after so long: the interpreter must not end
        around them."""
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
                _settle(future, job)
            del entry, future, job  # a waiting thread holds on to nothing


def _lower_priority(name: str, nice: int) -> None:
    """Of the thread that calls it, from where its process is; not where a sandbox forbids it."""
    if not nice or sys.platform != "linux":
        return
    thread = get_native_id()
    try:
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + nice)
    except OSError as error:
        log.warning("%s does not step back behind poses: %s", name, error.strerror)


def _settle(future: Future[Any], job: Callable[[], Any]) -> None:
    try:
        result = job()
    except (StopIteration, GeneratorExit, KeyboardInterrupt, SystemExit) as error:
        # asyncio cannot hand these on: the job failed, and that is all there is to know
        failure = RuntimeError(f"{type(error).__name__} was raised")
        failure.__cause__ = error
        future.set_exception(failure)
    except BaseException as error:
        future.set_exception(error)
    else:
        future.set_result(result)
