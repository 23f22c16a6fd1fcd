"""A run over a sequence, on the logical clock."""

from collections.abc import Callable
from pathlib import Path

from ldo_service.actors.graph import make_actors
from ldo_service.config import Config, config_yaml
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError
from ldo_service.runtime.logical_clock import LogicalClock

from .folder import RunFolder
from .source import Reader, Selection, Warn
from .summary import Usage, percentiles, summarise

Advance = Callable[[int], None]  # called with the number of frames done


def run_over_file(
    sequence: Sequence,
    folder: Path,
    config: Config,
    selection: Selection,
    warn: Warn,
    advance: Advance,
) -> RunFolder:
    """Run every actor over the chosen frames and write the folder.

    Independent of the machine's load: see `runtime.logical_clock`. A run that is interrupted or
    fails leaves what it has done, and its summary says so. Raises DataError when nothing or too
    little can be read, and StageError when an actor fails.
    """
    indices = selection.indices(sequence)
    actors = {actor.name: actor for actor in make_actors(config)}
    reader = Reader(sequence, indices, warn)
    record = RunFolder(folder, config_yaml(config), config.tracker.hold_out)
    clock = LogicalClock(
        list(actors.values()),
        config.run.latency_frames(),
        lambda _actor, message, step_ms: record.observe(message, step_ms),
    )
    started = Usage.now()
    is_finished = False
    try:
        for done in clock.run(reader):
            advance(done + 1 + reader.rejected)
        is_finished = True
    finally:
        used = Usage.now().since(started)
        rejected = reader.rejected + int(actors["frame_source"].facts()["frames_rejected"])
        stage_ms = {name: percentiles(steps) for name, steps in clock.step_ms().items() if steps}
        summary = summarise(record, used, len(indices), rejected, stage_ms, drops={})
        record.close({**summary, "interrupted": not is_finished})
    require_usable(record, config.run.max_rejected)
    return record


def require_usable(record: RunFolder, max_rejected: float) -> None:
    """Raise DataError when more than this share of the frames could not be used."""
    frames, rejected = record.summary["frames"], record.summary["frames_rejected"]
    if rejected > max_rejected * frames:
        raise DataError(
            f"{rejected} of {frames} frames could not be used. What could be done is in "
            f"{record.folder}. Check the data, or raise run.max_rejected."
        )
