"""Sequences in the layout that NICE-SLAM gave to Replica (Zhu et al., CVPR 2022).

results/frame*.jpg results/depth*.png    numbered images
traj.txt                                 optional: 16 numbers a line, camera to world by rows
cam_params.json                          here or one folder up: {"camera": {"w", "h", "fx",
                                         "fy", "cx", "cy", "scale"}}, scale in units per metre
labels.json semantic_class/ instance/    optional: what the pixels show, see `replica_labels`
"""

from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory, se3

from .calibration import Calibration, number, pinhole, read_json
from .images import read_color, read_depth
from .labels import TrueLabels
from .matrices import is_rigid
from .numbered import numbered, paired
from .replica_labels import ReplicaLabels
from .sequence import Sequence


class ReplicaSequence(Sequence):
    """Frames that have both colour and depth, in order of their numbers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        color = numbered(folder / "results", r"frame(\d+)\.(?:jpg|jpeg|png)")
        depth = numbered(folder / "results", r"depth(\d+)\.png")
        self._files = paired(color, depth, folder / "results")
        calibration = _calibration(folder)
        self.depth_scale = calibration.depth_scale
        super().__init__(folder.resolve().name, calibration.camera, self._files.stamps_ns)

    def read(self, index: int) -> RawFrame:
        return RawFrame(
            index,
            int(self.stamps_ns[index]),
            read_color(self._files.color[index]),
            read_depth(self._files.depth[index]),
            self.depth_scale,
            self.raw_camera,
        )

    def truth(self) -> Trajectory | None:
        path = self._folder / "traj.txt"
        if not path.is_file():
            return None
        poses = _poses(path)
        # One line per frame here, or one per number where some frames were removed.
        lines = self._files.numbers if len(poses) > len(self) else np.arange(len(self))
        known = lines < len(poses)
        return Trajectory(self.stamps_ns[known] / 1e9, poses[lines[known]])

    def true_labels(self) -> TrueLabels | None:
        return ReplicaLabels(self._folder, self._files.numbers).read()


def _calibration(folder: Path) -> Calibration:
    candidates = [folder / "cam_params.json", folder.resolve().parent / "cam_params.json"]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        raise DataError(
            f"no intrinsics: neither {candidates[0]} nor {candidates[1]} exists. Copy the "
            "cam_params.json that came with the data set there."
        )
    fields = read_json(path).get("camera")
    if not isinstance(fields, dict):
        raise DataError(f'{path}: expected an object under "camera".')
    return Calibration(pinhole(fields, "w", "h", path), number(fields, "scale", path))


def _poses(path: Path) -> np.ndarray:
    """T_world_camera [K, 4, 4] of the lines. Raises DataError with the line at fault."""
    try:
        lines = [line for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as poses: {error}.") from error
    return np.array([_pose(path, k, line) for k, line in enumerate(lines, 1)]).reshape(-1, 4, 4)


def _pose(path: Path, line_number: int, line: str) -> np.ndarray:
    try:
        T_world_camera = np.array([float(word) for word in line.split()]).reshape(4, 4)
    except ValueError:
        T_world_camera = np.full((4, 4), np.nan)
    if not is_rigid(T_world_camera):
        raise DataError(
            f"{path}, line {line_number}: expected the 16 numbers of a rigid 4x4 camera-to-world "
            f"matrix by rows, found {line[:80]!r}."
        )
    return se3.orthonormalised(T_world_camera)
