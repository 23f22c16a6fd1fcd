"""A run over a sequence, on the logical clock."""

import os
import resource
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service import kernels
from ldo_service.actors.graph import make_actors
from ldo_service.config import Config, config_yaml
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import CameraRgbd
from ldo_service.versions import versions
from ldo_service.wire import camera_rgbd_message

from .folder import RunFolder

READ_AHEAD = 3  # frames decoded before they are needed: one decoding, one waiting, one to spare

Warn = Callable[[str], None]
Advance = Callable[[int], None]  # called with the number of frames done


@dataclass(frozen=True, slots=True)
class Selection:
    """Which frames of a sequence."""

    stride: int = 1
    max_frames: int | None = None

    def indices(self, sequence: Sequence) -> range:
        chosen = range(0, len(sequence), self.stride)
        return chosen if self.max_frames is None else chosen[: self.max_frames]


class Reader:
    """Frames as camera messages, read ahead in a thread; bad ones are counted and left out."""

    def __init__(self, sequence: Sequence, indices: range, warn: Warn) -> None:
        self._sequence, self._indices, self._warn = sequence, indices, warn
        self.rejected = 0

    def __iter__(self) -> Iterator[CameraRgbd]:
        with ThreadPoolExecutor(1, "reader") as thread:
            ahead = [thread.submit(self._read, i) for i in self._indices[:READ_AHEAD]]
            for position in range(len(self._indices)):
                message = ahead.pop(0).result()
                following = position + READ_AHEAD
                if following < len(self._indices):
                    ahead.append(thread.submit(self._read, self._indices[following]))
                if message is not None:
                    yield message

    def _read(self, index: int) -> CameraRgbd | None:
        try:
            return camera_rgbd_message(self._sequence.read(index), compress_depth=False)
        except FrameError as error:
            if self.rejected == 0:
                self._warn(f"{error} It is left out; further bad frames are only counted.")
            self.rejected += 1
            return None


def run_over_file(
    sequence: Sequence,
    folder: Path,
    config: Config,
    selection: Selection,
    warn: Warn,
    advance: Advance,
) -> RunFolder:
    """Run every actor over the chosen frames and write the folder.

    Independent of the machine's load: see `runtime.logical_clock`. Raises DataError when nothing
    or too little can be read, and whatever an actor failed with.
    """
    indices = selection.indices(sequence)
    if not indices:
        raise DataError(f"{sequence.name}: the selection leaves no frame to run on.")
    actors = {actor.name: actor for actor in make_actors(config)}
    reader = Reader(sequence, indices, warn)
    record = RunFolder(folder, config_yaml(config), config.tracker.hold_out)
    clock = LogicalClock(
        list(actors.values()),
        config.run.latency_frames(),
        lambda _actor, message, step_ms: record.observe(message, step_ms),
    )
    started = Usage.now()
    for done in clock.run(reader):
        advance(done + 1 + reader.rejected)
    used = Usage.now().since(started)
    rejected = reader.rejected + int(actors["frame_source"].facts()["frames_rejected"])
    summary = summarise(record, clock, used, len(indices), rejected)
    record.close(summary)
    if rejected > config.run.max_rejected * len(indices):
        raise DataError(
            f"{rejected} of {len(indices)} frames of {sequence.name} could not be used. What could "
            f"be done is in {folder}. Check the data, or raise run.max_rejected."
        )
    return record


@dataclass(frozen=True, slots=True)
class Usage:
    """Time that this process has used."""

    wall_s: float
    cpu_s: float

    @staticmethod
    def now() -> "Usage":
        return Usage(time.perf_counter(), time.process_time())

    def since(self, earlier: "Usage") -> "Usage":
        return replace(self, wall_s=self.wall_s - earlier.wall_s, cpu_s=self.cpu_s - earlier.cpu_s)


def summarise(
    record: RunFolder, clock: LogicalClock, used: Usage, frames: int, rejected: int
) -> dict[str, Any]:
    """The summary of a finished run. FPS counts everything from the first read to the last step;
    nothing is excluded as warm-up."""
    return {
        "frames": frames,
        "frames_rejected": rejected,
        "status": record.statuses,
        "keyframes": record.keyframes,
        "gaussians": len(record.follower.map),
        "fps": round((frames - rejected) / used.wall_s, 3),
        "wall_s": round(used.wall_s, 3),
        "cpu_s": round(used.cpu_s, 3),
        "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "stage_ms": {name: percentiles(steps) for name, steps in clock.step_ms().items() if steps},
        "drops": {},  # the logical clock drops nothing
        "loops_accepted": 0,
        "loops_rejected": 0,
        "vlm_calls": 0,
        "optimizations": record.corrections,
        "isa": kernels.isa(),
        "threads": os.cpu_count(),
        "versions": versions(),
    }


def percentiles(values: list[float]) -> dict[str, float]:
    return {
        "p50": round(float(np.percentile(values, 50)), 3),
        "p95": round(float(np.percentile(values, 95)), 3),
    }
