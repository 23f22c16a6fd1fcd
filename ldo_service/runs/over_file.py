"""A run over a sequence, on the logical clock."""

import os
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ldo_service.actors.graph import make_actors
from ldo_service.config import Config, config_yaml
from ldo_service.errors import DataError
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import MapRefine

from .folder import RunFolder
from .job import REFINE_ITERATIONS, Advance, Job, requests
from .source import Reader, with_prior
from .summary import Percentiles, Usage, percentiles, summarise

LAST_RATE = 0.05  # of the steps when the map is refined: they shrink so far, to settle


def run_over_file(job: Job, advance: Advance) -> RunFolder:
    """Run every actor over the chosen frames, fit the map again where corrections have torn it, and
    write the folder; then refine the map, if asked.

    Independent of the machine's load: see `runtime.logical_clock`. A run that is interrupted or
    fails leaves what it has done, and its summary says so. Raises DataError when nothing or too
    little can be read, and StageError when an actor fails.
    """
    indices = job.selection.indices(job.sequence)
    config = with_all_cores(job.config)
    actors = {actor.name: actor for actor in make_actors(config)}
    reader = Reader(job.sequence, indices, job.warn)
    record = RunFolder(job.folder, config_yaml(job.config), job.config.tracker)
    started = Usage.now()
    work, stage_ms, is_finished = job.work, {}, False
    with LogicalClock(
        list(actors.values()),
        config.run.latency_frames(),
        lambda _actor, message, step_ms: record.observe(message, step_ms),
    ) as clock:
        try:
            for done in clock.run(with_prior(reader, job.prior)):
                advance(done + 1 + reader.rejected)
            clock.finish()
            stage_ms = percentiles_of(clock)
            if due := int(actors["mapper"].facts()["iterations_due"]):
                work += requests(due)
                for done in clock.run(refinements(due, record.newest_stamp_ns)):
                    advance(done + 1 + reader.rejected, work)
                clock.finish()
            is_finished = True
        finally:
            used = Usage.now().since(started)
            rejected = reader.rejected + int(actors["frame_source"].facts()["frames_rejected"])
            facts = actors["optimizer"].facts() | actors["mapper"].facts()
            stage_ms = stage_ms or percentiles_of(clock)
            summary = summarise(record, used, len(indices), rejected, stage_ms, {}, facts)
            record.close({**summary, "interrupted": not is_finished})
        require_usable(record, config.run.max_rejected)
        if job.refine:
            for done in clock.run(refinements(job.refine, record.newest_stamp_ns)):
                advance(done + 1 + reader.rejected, work)
            clock.finish()
            record.write_refined(job.refine)
    return record


def percentiles_of(clock: LogicalClock) -> dict[str, Percentiles]:
    """Of what the steps of each actor took so far."""
    return {name: percentiles(steps) for name, steps in clock.step_ms().items() if steps}


def with_all_cores(config: Config) -> Config:
    """Nobody is kept waiting by a run over a file: the renderer may use every core."""
    threads = config.mapper.threads or os.cpu_count() or 1
    return replace(config, mapper=replace(config.mapper, threads=threads))


def refinements(iterations: int, stamp_ns: int) -> Iterator[MapRefine]:
    """Requests of a bounded size, with steps that shrink from the first to the last."""
    starts = range(0, iterations, REFINE_ITERATIONS)
    ends = [min(start + REFINE_ITERATIONS, iterations) for start in starts]
    rates = LAST_RATE ** (np.array([0, *ends]) / iterations)
    for start, end, first, last in zip(starts, ends, rates[:-1], rates[1:], strict=True):
        yield MapRefine(
            stamp_ns=stamp_ns,
            iterations=end - start,
            first_rate=float(first),
            last_rate=float(last),
        )


def require_usable(record: RunFolder, max_rejected: float) -> None:
    """Raise DataError when more than this share of the frames could not be used."""
    frames, rejected = record.summary["frames"], record.summary["frames_rejected"]
    if rejected > max_rejected * frames:
        raise DataError(
            f"{rejected} of {frames} frames could not be used. What could be done is in "
            f"{record.folder}. Check the data, or raise run.max_rejected."
        )
