"""Stamped camera poses and their TUM text format. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError

from . import se3


@dataclass(frozen=True, slots=True)
class Trajectory:
    """stamps_s [K] float64, ascending; T_world_camera [K, 4, 4] float64."""

    stamps_s: np.ndarray
    T_world_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps_s)

    def save(self, path: Path) -> None:
        """Write `stamp tx ty tz qx qy qz qw` lines, quaternion last as the TUM format has it."""
        with path.open("w") as file:
            for stamp_s, T in zip(self.stamps_s, self.T_world_camera, strict=True):
                w, x, y, z = se3.quaternion(T[:3, :3])
                numbers = (*T[:3, 3], x, y, z, w)
                file.write(f"{stamp_s:.9f} " + " ".join(f"{n:.9f}" for n in numbers) + "\n")

    @staticmethod
    def load(path: Path) -> "Trajectory":
        """Read a TUM trajectory. Raises DataError with the line that does not read."""
        rows = []
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if not line.strip() or line.startswith("#"):
                continue
            try:
                row = [float(word) for word in line.split()]
            except ValueError:
                row = []
            if len(row) != 8 or not np.all(np.isfinite(row)):
                raise DataError(
                    f"{path}, line {number}: expected `stamp tx ty tz qx qy qz qw` "
                    f"in finite numbers, found {line[:80]!r}."
                )
            rows.append(row)
        table = np.array(rows, float).reshape(-1, 8)
        poses = [se3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
        return Trajectory(table[:, 0], np.array(poses).reshape(-1, 4, 4))
