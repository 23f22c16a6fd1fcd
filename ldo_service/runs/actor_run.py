"""Execution of a run's actors on a logical clock in this process, with a record of outputs."""

from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.actors.topology import make_actors
from ldo_service.config import Config, actor_parameters, config_yaml, latency_frames
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import Message, RefineMap

from .folder import RunWriter
from .job import REFINE_ITERATIONS
from .summary import Percentiles, Usage, percentiles, summarize

# Learning rates at the end of a refinement, as a fraction of those at its start. The rates
# decay so that the map converges.
LAST_RATE = 0.05


class ActorRun:
    """Actors of a run and the record of their outputs, used as a context manager.

    The module `runtime.logical_clock` explains why the results do not depend on the load of the
    machine. The threads of the actors end at the end of the context; the record can still be used.
    """

    def __init__(
        self,
        config: Config,
        folder: Path | None,
        without: Collection[str] = (),
        observe: Callable[[Message, int], None] = lambda _message, _tick: None,
    ) -> None:
        """Create the actors.

        Args:
            config: Configuration.
            folder: Folder for the results; None to keep them in memory.
            without: Names of actors that do not run.
            observe: Called with each output of an actor and the tick of its delivery.
        """
        parameters = actor_parameters(config)
        actors = [actor for actor in make_actors(parameters) if actor.name not in without]
        self.actors = {actor.name: actor for actor in actors}
        self.record = RunWriter(folder, config_yaml(config), parameters.tracker)
        self._observe_output = observe
        self._clock = LogicalClock(actors, latency_frames(config), self._observe)
        self._stage_ms: dict[str, Percentiles] = {}

    def __enter__(self) -> "ActorRun":
        self._clock.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._clock.__exit__(*error)

    def tick(self, item: Message | tuple[Message, ...]) -> int:
        """Deliver messages to the actors in a new tick; see `LogicalClock.tick`."""
        return self._clock.tick(item)

    def run(self, source: Iterable[Message | tuple[Message, ...]]) -> Iterator[int]:
        """Deliver each item of a source in a tick of its own, and then call `finish`.

        Yields:
            The number of each tick.
        """
        yield from self._clock.run(source)
        self._clock.finish()

    def finish(self) -> None:
        """Wait for all steps, and deliver the final messages; `tick` may be called afterwards."""
        self._clock.finish()

    def end_stream(self) -> None:
        """Let the actors finish after the last frame, and store their step times."""
        self.finish()
        self.keep_step_times()

    def keep_step_times(self) -> None:
        """Store the step times so far, so that the summary excludes a later refinement."""
        self._stage_ms = self._step_percentiles()

    @property
    def pending_iterations(self) -> int:
        """Number of pending iterations that refit the map to keyframes moved by corrections."""
        return int(self.actors["mapper"].metrics()["iterations_pending"])

    def summary(
        self, frames: int, rejected: int, used: Usage, *, is_finished: bool
    ) -> dict[str, Any]:
        """Return the summary of the frames so far.

        Args:
            frames: Number of frames.
            rejected: Number of unusable frames, not counting those that the actor frame_source
                rejected. This function adds the frames that frame_source rejected.
            used: Elapsed time and CPU time that the frames took.
            is_finished: False if the run was interrupted.
        """
        metrics = {name: actor.metrics() for name, actor in self.actors.items()}
        stage_ms = self._stage_ms or self._step_percentiles()
        if source := self.actors.get("frame_source"):
            rejected += int(source.metrics()["frames_rejected"])
        summary = summarize(self.record, used, frames, rejected, stage_ms, {}, metrics)
        return {**summary, "interrupted": not is_finished}

    def _observe(self, _actor: str, message: Message, step_ms: float) -> None:
        self.record.observe(message, step_ms)
        self._observe_output(message, self._clock.now)

    def _step_percentiles(self) -> dict[str, Percentiles]:
        """Return percentiles of the durations of all steps so far, by actor."""
        steps_of = self._clock.step_ms()
        return {name: percentiles(steps) for name, steps in steps_of.items() if steps}


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
