"""What a run wrote, read back. The files: `ldo_service.runs.folder`."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.datasets import Sequence
from ldo_service.errors import DataError
from ldo_service.gaussians.exposure import Exposure
from ldo_service.gaussians.ply import read_ply
from ldo_service.geometry import Trajectory

STAMP_TOLERANCE_S = 1e-6  # the files print stamps to the nanosecond, as float64 seconds


@dataclass(frozen=True, slots=True)
class RunFrame:
    """A line of frames.csv."""

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
    """A map [N, 16] (see `gaussians.model`), T_map_camera of the frames that are not LOST, and the
    exposures of its keyframes."""

    name: str  # online: at the end of the stream; refined: after further iterations
    rows: np.ndarray
    trajectory: Trajectory
    exposures: "Exposures"

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
    after further iterations (refined), where there were any."""

    folder: Path
    frames: tuple[RunFrame, ...]  # every frame that was tracked
    estimates: dict[str, Trajectory]
    maps: tuple[PosedMap, ...]  # one of the final poses, perhaps one of the refined

    @staticmethod
    def read(folder: Path) -> "FinishedRun":
        """Raises DataError for a file that is missing or cannot be read."""
        frames = _frames(folder / "frames.csv")
        maps = [_posed_map("online", folder)]
        if (folder / "refined").is_dir():
            maps.append(_posed_map("refined", folder / "refined"))
        estimates = {"online": Trajectory.load(_there(folder, "trajectory_online.txt"))}
        for name, posed in zip(("final", "refined"), maps, strict=False):
            estimates[name] = posed.trajectory
        return FinishedRun(folder, frames, estimates, tuple(maps))

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


def _frames(path: Path) -> tuple[RunFrame, ...]:
    try:
        with path.open(newline="") as file:
            return tuple(_frame(row) for row in csv.DictReader(file))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} cannot be read: {error!r}.") from error


def _frame(row: dict[str, str]) -> RunFrame:
    is_held_out = bool(int(row["held_out"]))
    return RunFrame(int(row["frame"]), int(row["stamp_ns"]), row["status"], is_held_out)


def _posed_map(name: str, folder: Path) -> PosedMap:
    rows = read_ply(_there(folder, "map.ply"))
    trajectory = Trajectory.load(_there(folder, "trajectory.txt"))
    return PosedMap(name, rows, trajectory, _exposures(_there(folder, "keyframes.json")))


def _exposures(path: Path) -> Exposures:
    """Of keyframes that have one; older versions wrote none."""
    try:
        keyframes = [k for k in json.loads(path.read_text()) if "exposure" in k]
        stamps_ns = np.array([int(k["stamp_ns"]) for k in keyframes], np.int64)
        matrices = np.array([k["exposure"] for k in keyframes], float).reshape(-1, 2, 3)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} cannot be read: {error!r}.") from error
    return Exposures(stamps_ns, matrices)


def _there(folder: Path, name: str) -> Path:
    if not (folder / name).is_file():
        raise DataError(f"{folder} has no {name}: is it what `ldo run` wrote?")
    return folder / name
