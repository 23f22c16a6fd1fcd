"""Benchmark of the mapper: CPU time per keyframe by stage, and errors on held-out frames.

A source is tracked once, and its keyframes are recorded. Each measurement maps these keyframes at
their final poses without corrections. Measurements with different settings of the mapper therefore
use the same keyframes and poses.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import msgspec
import numpy as np

from ldo_service.config import Config, checked
from ldo_service.conversions.frames import (
    camera_correction_from_message,
    frame_from_message,
    mask_from_array,
)
from ldo_service.errors import ConfigError, DeviceError
from ldo_service.evaluation.finished_run import Exposures, FinishedRun, PosedMap
from ldo_service.evaluation.views import view_of
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.gaussians.renderer import Rendering
from ldo_service.geometry import valid_pixels
from ldo_service.geometry.sequence import Sequence
from ldo_service.recordings.mcap_file import McapIndex
from ldo_service.schemas import Keyframe, decode
from ldo_service.schemas.topics import KEYFRAME_NEW

from .actor_run import LAST_RATE
from .finished import read_run
from .folder import prepare
from .front_end import FRONT_END, FrontEnd
from .job import Advance, RunOptions
from .offline import run_offline
from .source import Selection

HOLD_OUT = 5  # Every fifth frame is held out.
REFINEMENT_RATES = 1.0, LAST_RATE  # The rates of `ldo run --refine-iterations`.
# Stages of the mapper. "other" has pruning and the compression of keyframe images.
STAGES = ("first rendering", "densification", "iterations", "view", "other")


class HeldOutErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Errors on the held-out frames before the last keyframe.

    The PSNR follows protocol A, which `ldo_service.evaluation.views.PROTOCOL` describes.
    """

    mean_psnr_db: float
    median_psnr_db: float
    mean_depth_l1_cm: float
    median_depth_l1_cm: float


class MapMeasurement(msgspec.Struct, frozen=True, kw_only=True):
    """Measurement of the mapper on one source."""

    source: str  # Name of the source.
    frames: int
    keyframes: int
    effort: int  # Wanted optimizer iterations per keyframe, as in the setting mapper.iterations.
    iterations: int  # Iterations that were run, of all keyframes together.
    gaussians: int
    fps: float  # Frames of the source per CPU second of the mapper.
    cpu_ms: dict[str, float]  # CPU time of one thread per keyframe, by stage, and "all".
    online: HeldOutErrors
    refinement_cpu_s: float = 0.0  # CPU time of the refinement, seconds.
    refined: HeldOutErrors | None = None  # Errors after the refinement; None without one.


class TimedMapBuilder(MapBuilder):
    """Map builder that adds up the time of each stage, on one thread.

    On a CPU, it measures CPU time. On a GPU, it measures wall time. Wall time includes the work of
    the GPU, because the host waits for the GPU at the end of each series of iterations.

    Attributes:
        times_s: Time by stage, seconds.
    """

    def __init__(self, config: MapBuilderConfig) -> None:
        super().__init__(config)
        self.times_s: defaultdict[str, float] = defaultdict(float)
        self._clock = perf_counter if self.fitting.device.device == "cuda" else process_time

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a `with` block to a stage."""
        start = self._clock()
        yield
        self.times_s[stage] += self._clock() - start

    def render_from(self, *args: Any, **kwargs: Any) -> Rendering:
        with self.timed("first rendering"):
            return super().render_from(*args, **kwargs)

    def _insert(self, *args: Any, **kwargs: Any) -> None:
        with self.timed("densification"):
            super()._insert(*args, **kwargs)

    def _fit(self, *args: Any, **kwargs: Any) -> np.ndarray:
        with self.timed("iterations"):
            return super()._fit(*args, **kwargs)

    def cpu_ms(self, keyframes: int) -> dict[str, float]:
        """Return the CPU time per keyframe by stage, milliseconds; "all" is the sum."""
        spent = dict(self.times_s)
        spent["other"] = spent["all"] - sum(spent.get(stage, 0.0) for stage in STAGES)
        return {stage: 1000 * spent.get(stage, 0.0) / keyframes for stage in (*STAGES, "all")}


def require_device(builder: MapBuilder) -> None:
    """Check that the map builder has not fallen back from a GPU to the CPU.

    Raises:
        DeviceError: The GPU is missing or has failed.
    """
    if builder.fitting.device.has_failed:
        raise DeviceError(
            "the measurement is void, because the mapper used the CPU instead of the GPU: "
            f"{builder.fitting.device.reason}"
        )


@dataclass(frozen=True, slots=True)
class TrackedSource:
    """A source with its recorded keyframes.

    Attributes:
        sequence: The frames.
        run: The run that recorded the keyframes.
    """

    sequence: Sequence
    run: FinishedRun

    @classmethod
    def record(
        cls, sequence: Sequence, frames: int, config: Config, runs: Path, advance: Advance
    ) -> "TrackedSource":
        """Track a source and record its keyframes, or read the recording of an earlier call.

        Args:
            sequence: The frames.
            frames: Number of frames from the start; all if the source has fewer.
            config: Configuration. The settings of the mapper do not matter.
            runs: Folder with one folder per recording.
            advance: Function that receives the progress.

        Raises:
            ConfigError: The recording in `runs` was made with other settings of the tracker.
            DataError: Too few frames can be read.
        """
        name = re.sub(r"[^A-Za-z0-9@]+", "-", sequence.name).strip("-")
        folder, selection = runs / f"{name}-{frames}", Selection(1, frames)
        tracker = replace(config.tracker, hold_out=HOLD_OUT)
        mapper = replace(config.mapper, iterations=0)
        settings = checked(replace(config, tracker=tracker, mapper=mapper))
        if (folder / "map.ply").is_file():
            FrontEnd.open(folder, settings, sequence, selection)
        else:
            prepare(folder, True)
            job = RunOptions(
                *(sequence, folder, settings, selection, lambda _: None), keep_front_end=True
            )
            run_offline(job, advance)
        return cls(sequence, read_run(folder))

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the recorded keyframes."""
        index = McapIndex(self.run.folder / FRONT_END)
        for place in index.locations:
            if place.topic == KEYFRAME_NEW.name:
                yield decode(index.body(place), Keyframe)

    def final_pose(self, stamp_ns: int) -> np.ndarray:
        """Return the final T_map_camera [4, 4] of the frame with this stamp."""
        final = self.run.estimates["final"]
        return final.T_world_camera[int(np.abs(final.stamps_s - stamp_ns * 1e-9).argmin())]

    def measure(
        self, config: MapBuilderConfig, effort: int, refine_iterations: int = 0
    ) -> MapMeasurement:
        """Map the recorded keyframes on one thread, and measure CPU time and errors.

        The times include the rendering that the mapper publishes on `map/view`.

        Args:
            config: Settings of the map builder.
            effort: Number of optimizer iterations per keyframe, as in the setting
                mapper.iterations.
            refine_iterations: Number of iterations after the last keyframe.

        Raises:
            ConfigError: No keyframe was recorded.
            DeviceError: A GPU was asked for, and it failed.
        """
        builder, stamps = TimedMapBuilder(config), dict[int, int]()
        for message in self.keyframes():
            frame, mask = frame_from_message(message), mask_from_array(message.dynamic_mask)
            T_map_keyframe = self.final_pose(message.stamp_ns)
            correction = camera_correction_from_message(message.camera_correction)
            with builder.timed("all"):
                builder.add(frame, T_map_keyframe, message.keyframe, effort, mask, correction)
                with builder.timed("view"):
                    builder.render_keyframe(message.keyframe)
            stamps[message.keyframe] = message.stamp_ns
        if not stamps:
            raise ConfigError(
                f"{self.sequence.name}: no keyframe was mapped in {len(self.run.frames)} frames. "
                "Use more frames, or a source that the tracker can follow."
            )
        require_device(builder)
        measured = MapMeasurement(
            source=self.sequence.name,
            frames=len(self.run.frames),
            keyframes=len(stamps),
            effort=effort,
            iterations=builder.fitting.iterations,
            gaussians=builder.size(),
            fps=len(self.run.frames) / builder.times_s["all"],
            cpu_ms=builder.cpu_ms(len(stamps)),
            online=self._errors(builder, stamps),
        )
        if not refine_iterations:
            return measured
        with builder.timed("refinement"):
            builder.refine(refine_iterations, REFINEMENT_RATES)
        require_device(builder)
        return msgspec.structs.replace(
            measured,
            refinement_cpu_s=builder.times_s["refinement"],
            refined=self._errors(builder, stamps),
        )

    def _errors(self, builder: MapBuilder, stamps: dict[int, int]) -> HeldOutErrors:
        """Return the errors of a map; `stamps` has the stamp of each keyframe in nanoseconds."""
        known = sorted(k for k in stamps if k in builder.views.exposures)
        exposures = Exposures(
            np.array([stamps[k] for k in known]),
            np.array([builder.views.exposures[k].matrix for k in known]),
        )
        return self.held_out_errors(builder.gaussians.rows, exposures, max(stamps.values()))

    def held_out_errors(
        self, rows: np.ndarray, exposures: Exposures, last_ns: int
    ) -> HeldOutErrors:
        """Return the errors of a map on the held-out frames before its last keyframe.

        Args:
            rows: Gaussians of the map, [N, 16]; see `gaussians.rows`.
            exposures: Exposures of the keyframes.
            last_ns: Stamp of the last keyframe, nanoseconds.

        Raises:
            ConfigError: No held-out frame lies before the last keyframe.
        """
        map_ = self.run.maps[0]
        posed = PosedMap("trial", rows, map_.trajectory, exposures, None, map_.correction)
        valid, found = valid_pixels(self.sequence.raw_camera), []
        for frame in self.run.frames:
            if not frame.is_held_out or frame.is_lost or frame.stamp_ns > last_ns:
                continue
            image = self.sequence[frame.index]
            fits = valid is not None and valid.shape == image.depth_m.shape
            view = view_of(image, posed, frame, 1, valid if fits else None)
            rendering, measured_m = view.rendering, view.frame.depth_m
            seen = (measured_m > 0) & (rendering.opacity > 0.5)
            l1_m = np.abs(rendering.depth_m - measured_m)[seen].mean()
            found.append((view.psnr_db, 100 * l1_m))
        if not found:
            raise ConfigError(
                f"{self.sequence.name}: no held-out frame lies before the last keyframe. Use more "
                "frames."
            )
        mean, median = np.mean(found, axis=0).tolist(), np.median(found, axis=0).tolist()
        return HeldOutErrors(
            mean_psnr_db=mean[0],
            median_psnr_db=median[0],
            mean_depth_l1_cm=mean[1],
            median_depth_l1_cm=median[1],
        )
