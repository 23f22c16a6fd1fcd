"""Offline run over a sequence: actors run on a logical clock, not in real time."""

import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from ldo_service.actors.topology import make_actors
from ldo_service.config import Config, actor_parameters, config_yaml, latency_frames
from ldo_service.errors import DataError
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import Message, RefineMap

from .folder import RunWriter
from .front_end import ACTORS, FrontEnd, FrontEndRecord
from .job import REFINE_ITERATIONS, Advance, RunOptions, requests
from .source import FrameReader, interleave_prior
from .summary import Percentiles, Usage, percentiles, summarize

# Learning rates at the end of a refinement, as a fraction of those at its start. The rates decay so
# that the map converges.
LAST_RATE = 0.05


def run_offline(job: RunOptions, advance: Advance) -> RunWriter:
    """Run every actor over the selected frames, and write the results to the folder.

    After the last frame, the map is refitted to keyframes that corrections have moved. It is then
    refined if `job.refine` is not 0. The result does not depend on the load of the machine; see
    `runtime.logical_clock`. An interrupted or failed run leaves partial results, which its summary
    marks as interrupted.

    Args:
        job: Options of the run.
        advance: Function that receives the progress.

    Raises:
        DataError: Too few frames can be read.
        StageError: An actor failed.
    """
    with OfflineRun(job, advance) as run:
        try:
            run.stream()
            run.repair()
        finally:
            run.close()
        require_usable(run.record, job.config.offline.max_rejected_ratio)
        if job.refine:
            run.refine()
    return run.record


class OfflineRun:
    """Offline run as a context manager.

    The caller calls its phases in this order: `stream`, `repair`, `close`, and optionally `refine`.
    """

    def __init__(self, job: RunOptions, advance: Advance) -> None:
        self._job, self._advance, self._work = job, advance, job.work
        self._frames = job.selection.indices(job.sequence)
        config = with_all_cores(job.config)
        parameters = actor_parameters(config)
        actors = [
            actor
            for actor in make_actors(parameters)
            if not (job.front_end and actor.name in ACTORS)
        ]
        self._actors = {actor.name: actor for actor in actors}
        self._reader = FrameReader(job.sequence, self._frames, job.warn)
        self.record = RunWriter(job.folder, config_yaml(job.config), parameters.tracker)
        self._kept: FrontEndRecord | None = None
        self._clock = LogicalClock(actors, latency_frames(config), self._observe)
        self._started = Usage.now()
        self._stage_ms: dict[str, Percentiles] = {}
        self._is_finished = False

    def __enter__(self) -> "OfflineRun":
        self._clock.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._clock.__exit__(*error)

    def stream(self) -> None:
        """Process every selected frame, and record the front end if `keep_front_end` is set."""
        job = self._job
        frames = interleave_prior(self._reader, job.prior)
        with ExitStack() as kept:
            if job.keep_front_end:
                record = FrontEndRecord(job.folder, job.config, job.sequence, job.selection)
                self._kept = kept.enter_context(record)
            self._run(self._recorded_messages(job.front_end) if job.front_end else frames)
        self._kept = None
        self._stage_ms = self._step_percentiles()

    def repair(self) -> None:
        """Run the pending refit iterations for keyframes that corrections have moved."""
        if due := int(self._actors["mapper"].metrics()["iterations_pending"]):
            self._work += requests(due)
            self._run(refinements(due, self.record.newest_stamp_ns))
        self._is_finished = True

    def close(self) -> None:
        """Write the results and the summary of all frames processed so far."""
        used = Usage.now().since(self._started)
        facts = self._actors["optimizer"].metrics() | self._actors["mapper"].metrics()
        stage_ms = self._stage_ms or self._step_percentiles()
        frames, rejected = len(self._frames), self._rejected()
        summary = summarize(self.record, used, frames, rejected, stage_ms, {}, facts)
        self.record.close({**summary, "interrupted": not self._is_finished})

    def refine(self) -> None:
        """Run the requested refinement and write its results to their own folder."""
        self._run(refinements(self._job.refine, self.record.newest_stamp_ns))
        self.record.write_refined(self._job.refine)

    def _run(self, source: Iterable[Message | tuple[Message, ...]]) -> None:
        for tick in self._clock.run(source):
            done = tick + 1 + self._reader.rejected
            self._advance(min(done, self._work), self._work)
        self._clock.finish()

    def _recorded_messages(self, front_end: FrontEnd) -> Iterator[tuple[Message, ...]]:
        for messages in front_end:
            for message in messages:
                self.record.observe(message, step_ms=0.0)
            yield messages

    def _observe(self, _actor: str, message: Message, step_ms: float) -> None:
        self.record.observe(message, step_ms)
        if self._kept:
            self._kept.observe(message, self._clock.now)

    def _rejected(self) -> int:
        if self._job.front_end:
            return self._job.front_end.rejected
        by_source = int(self._actors["frame_source"].metrics()["frames_rejected"])
        return self._reader.rejected + by_source

    def _step_percentiles(self) -> dict[str, Percentiles]:
        """Return percentiles of the durations of all steps so far, by actor."""
        steps_of = self._clock.step_ms()
        return {name: percentiles(steps) for name, steps in steps_of.items() if steps}


def with_all_cores(config: Config) -> Config:
    """Return the configuration with a renderer that may use every CPU core.

    In a live service, the renderer leaves one core to the tracker. An offline run does not need
    this, since no frame can be late.
    """
    threads = config.mapper.threads or os.cpu_count() or 1
    return replace(config, mapper=replace(config.mapper, threads=threads))


def refinements(iterations: int, stamp_ns: int) -> Iterator[RefineMap]:
    """Yield refinement requests of bounded size with decaying learning rates.

    Args:
        iterations: Number of iterations of all requests together.
        stamp_ns: Stamp of the requests.
    """
    starts = range(0, iterations, REFINE_ITERATIONS)
    ends = [min(start + REFINE_ITERATIONS, iterations) for start in starts]
    rates = LAST_RATE ** (np.array([0, *ends]) / iterations)
    for start, end, first, last in zip(starts, ends, rates[:-1], rates[1:], strict=True):
        yield RefineMap(
            stamp_ns=stamp_ns,
            iterations=end - start,
            initial_rate=float(first),
            final_rate=float(last),
        )


def require_usable(record: RunWriter, max_rejected: float) -> None:
    """Check that enough frames could be used.

    Args:
        record: The finished run.
        max_rejected: Maximum fraction of rejected frames.

    Raises:
        DataError: A larger fraction of frames was rejected.
    """
    frames, rejected = record.summary["frames"], record.summary["frames_rejected"]
    if rejected > max_rejected * frames:
        raise DataError(
            f"{rejected} of {frames} frames could not be used, more than "
            f"offline.max_rejected_ratio={max_rejected:g} allows. The results of the other frames "
            f"are in {record.folder}. Check the data, or raise the setting."
        )
