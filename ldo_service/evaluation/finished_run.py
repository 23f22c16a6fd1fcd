"""Data of a finished run for evaluation; `ldo_service.runs.finished` reads the run folder."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.calibration.shutter import FrameMotion
from ldo_service.errors import DataError
from ldo_service.gaussians.exposure import Exposure
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.semantics.semantics_file import SavedSemantics

from .instances import SavedObjects
from .loops import FoundLoops

# Stamps that differ less are equal: float64 seconds cannot represent the nanoseconds of the files.
STAMP_TOLERANCE_S = 1e-6
# Maximum time between the frame before and the frame after a frame, from which the motion of the
# camera during this frame is computed.
MAX_MOTION_INTERVAL_S = 0.3


@dataclass(frozen=True, slots=True)
class RunFrame:
    """Frame that the tracker processed in a run, with its tracking status."""

    index: int  # Index in the sequence.
    stamp_ns: int
    status: str  # Tracking status: OK, WEAK or LOST.
    is_held_out: bool  # Tracked, but never mapped.

    @property
    def is_lost(self) -> bool:
        """True if the tracking status is LOST; such a frame has no pose."""
        return self.status == "LOST"


@dataclass(frozen=True, slots=True)
class FrameCounts:
    """Frame counts of a run: all tracked frames, frames with a pose, and frames with status OK."""

    frames: int
    with_pose: int  # Frames with a pose in the map; frames of unmerged submaps have none.
    ok: int  # Frames with a pose in the map and the status OK.

    def __str__(self) -> str:
        if self.frames == 0:
            return "No frame was tracked."
        return (
            f"{self.with_pose} of {self.frames} frames have a pose "
            f"({self.with_pose / self.frames:.1%}). Of these, {self.ok} have status OK "
            f"({self.ok / self.frames:.1%} of all)."
        )


@dataclass(frozen=True, eq=False, slots=True)
class Exposures:
    """Exposures of the keyframes.

    Attributes:
        stamps_ns: Stamps of the K keyframes, [K], nanoseconds, ascending.
        matrices: Gains (row 0) and biases (row 1) of the three color channels, [K, 2, 3].
    """

    stamps_ns: np.ndarray
    matrices: np.ndarray

    def at(self, stamp_ns: int) -> Exposure:
        """Return the exposure at a stamp, interpolated linearly between the neighboring keyframes.

        If there are no keyframes, the result is the default exposure, which does not change the
        colors of the map.
        """
        if len(self.stamps_ns) == 0:
            return Exposure()
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        before, after = max(after - 1, 0), min(after, len(self.stamps_ns) - 1)
        interval = int(self.stamps_ns[after] - self.stamps_ns[before])
        elapsed = int(np.clip(stamp_ns - self.stamps_ns[before], 0, interval))
        share = elapsed / interval if interval else 0.0
        return Exposure.of((1 - share) * self.matrices[before] + share * self.matrices[after])


@dataclass(frozen=True, eq=False, slots=True)
class PosedMap:
    """A map with the poses, exposures and labels that belong to it.

    Attributes:
        name: "online" for the map at the end of the run, "refined" for the map after further
            optimization.
        rows: Gaussians, [N, 16] (see `gaussians.rows`).
        trajectory: Poses T_map_camera of the frames that are not LOST.
        exposures: Exposures of the keyframes.
        semantics: Labels of the Gaussians; None without a detector.
        correction: Vignetting and depth bias to which the map has converted its keyframes, and the
            last timing of the shutter.
        objects: Objects of the map; None without a detector.
    """

    name: str
    rows: np.ndarray
    trajectory: Trajectory
    exposures: Exposures
    semantics: SavedSemantics | None = None
    correction: CameraCorrection = field(default_factory=CameraCorrection)
    objects: SavedObjects | None = None

    def T_map_camera(self, frame: RunFrame) -> np.ndarray:
        """Return the pose of a frame, the transform from the camera to the map, [4, 4].

        Raises:
            DataError: If the trajectory has no pose for the frame.
        """
        gaps_s = np.abs(self.trajectory.stamps_s - frame.stamp_ns * 1e-9)
        if len(gaps_s) == 0 or gaps_s.min() > STAMP_TOLERANCE_S:
            raise DataError(
                f"the {self.name} trajectory has no pose for frame {frame.index}, which has status "
                f"{frame.status} in frames.csv: the run folder is incomplete. Repeat the run."
            )
        return self.trajectory.T_world_camera[gaps_s.argmin()]

    def motion(self, frame: RunFrame) -> FrameMotion | None:
        """Compute the motion of the camera during a frame from the frames before and after it.

        Returns:
            The motion. None if one of the two neighboring frames is missing, if they are more than
            0.3 s apart, if the motion is implausible, or if no shutter timing is known.
        """
        timing = self.correction.timing
        stamps_s = self.trajectory.stamps_s
        if not timing or len(stamps_s) < 3:
            return None
        index = int(np.abs(stamps_s - frame.stamp_ns * 1e-9).argmin())
        if not 0 < index < len(stamps_s) - 1:
            return None
        interval_s = float(stamps_s[index + 1] - stamps_s[index - 1])
        if interval_s > MAX_MOTION_INTERVAL_S:
            return None
        before, after = self.trajectory.T_world_camera[[index - 1, index + 1]]
        return FrameMotion.between(before, after, interval_s, timing)


@dataclass(frozen=True, eq=False, slots=True)
class FinishedRun:
    """Frames, trajectories, maps and loop closures of a finished run."""

    folder: Path  # Folder of the run; pictures are saved here.
    frames: tuple[RunFrame, ...]  # Tracked frames of the run.
    # Trajectories T_map_camera: "online" as published during the run, "final" after the last
    # correction of the pose graph, and "refined" if the map was optimized further after the run.
    estimates: dict[str, Trajectory]
    # Maps at the final poses and, if there are any, at the refined poses; none after localization.
    maps: tuple[PosedMap, ...]
    vlm_calls: int | None = None  # Calls of the labeller; None if the run did not record them.
    loops: FoundLoops | None = None  # Found loops; None if loop closing was off.
    # Index in the sequence of each keyframe's frame, by keyframe id.
    keyframes: Mapping[int, int] = field(default_factory=dict)

    def frame(self, index: int) -> RunFrame:
        """Return the frame that has this index in the sequence."""
        return next(frame for frame in self.frames if frame.index == index)

    def counts(self) -> FrameCounts:
        """Count all frames, frames with a pose in the map, and frames with pose and status OK."""
        final = self.estimates["final"]
        ok = at_stamps(final, self.stamps_s("OK"))
        return FrameCounts(len(self.frames), len(final.stamps_s), len(ok.stamps_s))

    def stamps_s(self, status: str) -> np.ndarray:
        """Return the stamps of all frames with this tracking status, [M], seconds, ascending."""
        return np.array([f.stamp_ns * 1e-9 for f in self.frames if f.status == status])

    def require_source(self, sequence: Sequence) -> None:
        """Check that the sequence has every frame of the run, with the same index and stamp.

        Raises:
            DataError: If a frame is missing or has another stamp.
        """
        for frame in self.frames:
            is_there = 0 <= frame.index < len(sequence)
            if not is_there or sequence.stamps_ns[frame.index] != frame.stamp_ns:
                raise DataError(
                    f"frame {frame.index} of the run has the stamp {frame.stamp_ns} ns, but "
                    f"{sequence.name} has no frame with this index and stamp. Give the SOURCE of "
                    "the run: the source that the run processed."
                )


def at_stamps(trajectory: Trajectory, stamps_s: np.ndarray) -> Trajectory:
    """Return the poses of a trajectory that have one of the given stamps.

    Args:
        trajectory: The trajectory.
        stamps_s: Stamps to select, [M], seconds, ascending.
    """
    if len(stamps_s) == 0:
        return Trajectory(trajectory.stamps_s[:0], trajectory.T_world_camera[:0])
    nearest = np.searchsorted(stamps_s, trajectory.stamps_s - STAMP_TOLERANCE_S)
    gaps_s = stamps_s[np.minimum(nearest, len(stamps_s) - 1)] - trajectory.stamps_s
    chosen = np.abs(gaps_s) <= STAMP_TOLERANCE_S
    return Trajectory(trajectory.stamps_s[chosen], trajectory.T_world_camera[chosen])
