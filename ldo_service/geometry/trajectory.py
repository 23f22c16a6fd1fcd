"""Stamped camera poses and their TUM text format. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError

from . import se3


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Camera poses with ascending stamps.

    Raises:
        DataError: The shapes disagree, or the stamps descend.
    """

    stamps_s: np.ndarray  # [K] float64.
    T_world_camera: np.ndarray  # [K, 4, 4] float64.

    def __post_init__(self) -> None:
        if self.T_world_camera.shape != (*self.stamps_s.shape, 4, 4):
            raise DataError(
                f"trajectory has stamps of shape {self.stamps_s.shape} and transforms of shape "
                f"{self.T_world_camera.shape}, expected [K] and [K, 4, 4]."
            )
        if np.any(np.diff(self.stamps_s) < 0):
            raise DataError("the stamps of a trajectory must ascend. Sort its poses by stamp.")

    def __len__(self) -> int:
        return len(self.stamps_s)

    def save(self, path: Path) -> None:
        """Write lines of `stamp tx ty tz qx qy qz qw`, the TUM format."""
        with path.open("w") as file:
            for stamp_s, T in zip(self.stamps_s, self.T_world_camera, strict=True):
                w, x, y, z = se3.quaternion(T[:3, :3])
                numbers = (*T[:3, 3], x, y, z, w)
                file.write(f"{stamp_s:.9f} " + " ".join(f"{n:.9f}" for n in numbers) + "\n")

    @staticmethod
    def load(path: Path) -> "Trajectory":
        """Read a TUM trajectory, and sort it by stamp.

        Raises:
            DataError: The file cannot be read, or a line is invalid.
        """
        try:
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(
                f"{path} cannot be read as a TUM trajectory: {error}. Give a readable text file."
            ) from error
        rows = [
            _row(path, number, line)
            for number, line in enumerate(lines, 1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
        table = np.array(rows, float).reshape(-1, 8)
        table = table[np.argsort(table[:, 0], kind="stable")]
        poses = [se3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
        return Trajectory(table[:, 0], np.array(poses).reshape(-1, 4, 4))


def _row(path: Path, number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != 8 or not np.all(np.isfinite(row)) or not any(row[4:]):
        raise DataError(
            f"{path}, line {number}: expected `stamp tx ty tz qx qy qz qw` with finite numbers "
            f"and a nonzero quaternion, found {line[:80]!r}. Correct this line."
        )
    return row
