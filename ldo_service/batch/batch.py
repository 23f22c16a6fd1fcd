"""Batch of recordings: a job for each recording without results, and all outcomes."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from msgspec import structs

from ldo_service.errors import LdoError

from .executors import Executor
from .job import KEY_DIGITS, BatchJob, Outcome, RunPlan, key_of
from .results import ResultFolder
from .sources import Recording, measure
from .staging import remove_abandoned
from .store import Store

# Threads that compute the digests of recordings. They read local files, or wait for a bucket.
LOOKUP_THREADS = 4


@dataclass(frozen=True, slots=True)
class Batch:
    """Options of a batch.

    Attributes:
        plan: Settings of the work on each recording.
        out: Folder with all results.
        staging: Temporary folder for copies of recordings and for unfinished results.
        max_staged_bytes: Maximum total size of the copies of recordings on one machine, bytes.
    """

    plan: RunPlan
    out: Store
    staging: Path
    max_staged_bytes: int

    def outcomes(
        self,
        sources: Sequence[str],
        executor: Executor,
        begun: Callable[[list[BatchJob]], None],
    ) -> Iterator[Outcome]:
        """Yield the outcome of each recording; recordings with finished results come first.

        Args:
            sources: Paths or addresses of the recordings, without repetition.
            executor: Executor of the jobs.
            begun: Function that is called with all jobs to run, before the first one starts.
        """
        jobs, seen = list[BatchJob](), dict[str, str]()
        for source, found in zip(sources, self._looked_up(sources), strict=True):
            if found.folder and found.folder in seen:
                yield _duplicate(source, seen[found.folder])
                continue
            seen[found.folder] = source
            if isinstance(found, BatchJob):
                jobs.append(found)
            else:
                yield found
        begun(jobs)
        try:
            with closing(executor.outcomes(jobs)) as outcomes:
                yield from outcomes
        finally:
            remove_abandoned(self.staging)

    def _looked_up(self, sources: Iterable[str]) -> Iterator[BatchJob | Outcome]:
        """Yield a job for each source without results, and an outcome for each other source.

        The outcome is that of the finished results, or a failure if the source cannot be read.
        """
        with ThreadPoolExecutor(LOOKUP_THREADS, "lookup") as threads:
            yield from threads.map(self._look_up, sources)

    def _look_up(self, source: str) -> BatchJob | Outcome:
        try:
            job = self.job(measure(source))
            kept = ResultFolder.of(job).finished()
        except LdoError as error:
            name = Path(source).name
            return Outcome(source=source, name=name, folder="", status="failed", error=str(error))
        return (
            job if kept is None else structs.replace(kept, source=source, name=job.recording.name)
        )

    def job(self, recording: Recording) -> BatchJob:
        """Return the job of a recording.

        The folder of the results is named after the recording and the first `KEY_DIGITS` digits of
        a digest. `key_of` computes this digest of everything that the results depend on.
        """
        key = key_of(recording, self.plan)
        return BatchJob(
            recording=recording,
            plan=self.plan,
            out=self.out.url,
            folder=f"{recording.name}-{key[:KEY_DIGITS]}",
            key=key,
            staging=str(self.staging),
            max_staged_bytes=self.max_staged_bytes,
        )


def _duplicate(source: str, other: str) -> Outcome:
    text = f"It has the same name and content as {other}, which is run once."
    name = Path(source).name
    return Outcome(source=source, name=name, folder="", status="duplicate", error=text)


def default_workers(threads: int, memory_gb: float) -> int:
    """Return the number of recordings that this machine can process at the same time.

    Args:
        threads: Threads for each recording; 0 for all cores.
        memory_gb: Memory for each recording, GB; 0 for no limit by memory.
    """
    cores = len(os.sched_getaffinity(0))
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    by_memory = int(memory_bytes / (memory_gb * 1e9)) if memory_gb > 0 else cores
    return max(1, min(cores // (threads or cores), by_memory))
