"""Interface of the executors of batch jobs, and the executor for this machine."""

import os
import signal
import threading
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from typing import Protocol

from .job import BatchJob, Outcome, failed
from .work import process

# Variables that limit the threads of libraries. They are read when a library is loaded.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Executor(Protocol):
    """Interface of the executors of batch jobs."""

    def outcomes(self, jobs: Iterable[BatchJob]) -> Generator[Outcome, None, None]:
        """Yield the outcome of each job, in the order in which the jobs finish.

        Closing the iterator ends all running jobs, for example after a KeyboardInterrupt in the
        caller.

        Args:
            jobs: The jobs. The executor takes the next one when a process is free.
        """
        ...


@dataclass(frozen=True, slots=True)
class LocalExecutor:
    """Executor on this machine: each job in a process of its own.

    A process pool of the standard library fails as a whole if one of its processes dies. Each job
    therefore has its own pool of one process. If the kernel kills one process, the other jobs
    continue. Each job also starts with fresh memory and its own limit of threads.

    Attributes:
        workers: Maximum number of jobs at the same time.
    """

    workers: int

    def outcomes(self, jobs: Iterable[BatchJob]) -> Generator[Outcome, None, None]:
        """Yield the outcome of each job; see `Executor.outcomes`."""
        waiting = iter(jobs)
        running: dict[Future[Outcome], tuple[BatchJob, ProcessPoolExecutor]] = {}
        parent_end, worker_end = Pipe(duplex=False)[::-1]
        try:
            while True:
                for job in islice(waiting, self.workers - len(running)):
                    pool = ProcessPoolExecutor(
                        1, get_context("spawn"), _end_with_parent, (worker_end,)
                    )
                    with _child_environment(job.plan.threads):
                        running[pool.submit(process, job)] = job, pool
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    job, pool = running.pop(future)
                    pool.shutdown()
                    yield _outcome(future, job)
        finally:
            parent_end.close()  # Ends the processes that are still running.
            for _, pool in running.values():
                pool.shutdown(cancel_futures=True)
            worker_end.close()


def _outcome(future: Future[Outcome], job: BatchJob) -> Outcome:
    try:
        return future.result()
    except BrokenProcessPool:
        return failed(
            job,
            "its process was killed, often because the memory of the machine was exhausted. Use "
            "fewer --workers, and repeat the command.",
        )


def _end_with_parent(parent: Connection) -> None:
    """Let this process end as soon as the other end of a pipe is closed.

    This happens if the batch is interrupted, and also if its process is killed.
    """

    def watch() -> None:
        try:
            parent.recv_bytes()
        except (EOFError, OSError):
            os._exit(130)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def _child_environment(threads: int) -> Iterator[None]:
    """Set the environment of a process that is started in the context.

    SIGINT stays blocked in the process, because Ctrl-C in a terminal sends it to all processes. The
    batch ends its processes itself, so none of them prints a traceback.
    """
    limits = {name: str(threads) for name in THREADS if threads and name not in os.environ}
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(limits)
    try:
        yield
    finally:
        for name in limits:
            del os.environ[name]
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
