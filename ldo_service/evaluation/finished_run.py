"""What is judged of a run. `ldo_service.runs.finished` reads it from a folder."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.gaussians.exposure import Exposure
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.semantics.semantics_file import SavedSemantics

from .loops import FoundLoops

STAMP_TOLERANCE_S = 1e-6  # the files print stamps to the nanosecond, as float64 seconds


@dataclass(frozen=True, slots=True)
class RunFrame:
    """A frame that was tracked."""

    index: int  # in the sequence
    stamp_ns: int
    status: str  # OK, WEAK or LOST
    is_held_out: bool  # tracked, never mapped

    @property
    def is_lost(self) -> bool:
        return self.status == "LOST"


@dataclass(frozen=True, eq=False, slots=True)
class Exposures:
    """Of the keyframes: stamps_ns [K] ascending, gains and biases [K, 2, 3]."""

    stamps_ns: np.ndarray
    matrices: np.ndarray

    def at(self, stamp_ns: int) -> Exposure:
        """Linear in time between the keyframes before and after; that of the map without any."""
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
    """A map [N, 16] (see `gaussians.model`), T_map_camera of the frames that are not LOST, the
    exposures of its keyframes, and what its Gaussians are if a detector looked."""

    name: str  # online: as the run left it; refined: after further iterations
    rows: np.ndarray
    trajectory: Trajectory
    exposures: Exposures
    semantics: SavedSemantics | None = None

    def T_map_camera(self, frame: RunFrame) -> np.ndarray:
        """[4, 4]. Raises DataError when there is none."""
        gaps_s = np.abs(self.trajectory.stamps_s - frame.stamp_ns * 1e-9)
        if len(gaps_s) == 0 or gaps_s.min() > STAMP_TOLERANCE_S:
            raise DataError(
                f"the {self.name} trajectory has no pose for frame {frame.index}, which frames.csv "
                f"calls {frame.status}: the folder is incomplete. Run again."
            )
        return self.trajectory.T_world_camera[gaps_s.argmin()]


@dataclass(frozen=True, eq=False, slots=True)
class FinishedRun:
    """`estimates` holds T_map_camera as published (online), after the last correction (final), and
    after further iterations (refined), where there were any. Pictures are drawn into `folder`."""

    folder: Path
    frames: tuple[RunFrame, ...]  # every frame that was tracked
    estimates: dict[str, Trajectory]
    # one of the final poses, perhaps one of the refined; none of a run that localised
    maps: tuple[PosedMap, ...]
    vlm_calls: int | None = None  # of the labeller; None where the run does not say
    loops: FoundLoops | None = None  # None: it looked for none
    keyframes: Mapping[int, int] = field(default_factory=dict)  # id to index of the frame

    def frame(self, index: int) -> RunFrame:
        return next(frame for frame in self.frames if frame.index == index)

    def stamps_s(self, status: str) -> np.ndarray:
        """Of the frames with a status [M], ascending."""
        return np.array([f.stamp_ns * 1e-9 for f in self.frames if f.status == status])

    def require_source(self, sequence: Sequence) -> None:
        """Raise DataError when the frames are not those of the sequence."""
        for frame in self.frames:
            is_there = 0 <= frame.index < len(sequence)
            if not is_there or sequence.stamps_ns[frame.index] != frame.stamp_ns:
                raise DataError(
                    f"the run had a frame {frame.index} at {frame.stamp_ns} ns, and "
                    f"{sequence.name} has none: give the SOURCE that the run was made from."
                )


def at_stamps(trajectory: Trajectory, stamps_s: np.ndarray) -> Trajectory:
    """The poses whose stamp is among `stamps_s` [M], ascending."""
    if len(stamps_s) == 0:
        return Trajectory(trajectory.stamps_s[:0], trajectory.T_world_camera[:0])
    nearest = np.searchsorted(stamps_s, trajectory.stamps_s - STAMP_TOLERANCE_S)
    gaps_s = stamps_s[np.minimum(nearest, len(stamps_s) - 1)] - trajectory.stamps_s
    chosen = np.abs(gaps_s) <= STAMP_TOLERANCE_S
    return Trajectory(trajectory.stamps_s[chosen], trajectory.T_world_camera[chosen])
