"""Sequences in the layout that NICE-SLAM gave to Replica (Zhu et al., CVPR 2022).

results/frame*.jpg results/depth*.png    numbered images
traj.txt                                 optional: 16 numbers a line, camera to world by rows
cam_params.json                          here or one folder up: {"camera": {"w", "h", "fx",
                                         "fy", "cx", "cy", "scale"}}, scale in units per metre
"""

import re
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory, se3

from .calibration import Calibration, number, pinhole, read_json
from .images import read_color, read_depth
from .sequence import Sequence

FRAME_RATE_HZ = 30  # the layout has no stamps; frame k is said to be taken at k / 30 s


class ReplicaSequence(Sequence):
    """Frames that have both colour and depth, in order of their numbers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        color = _numbered(folder / "results", r"frame(\d+)\.(?:jpg|jpeg|png)")
        depth = _numbered(folder / "results", r"depth(\d+)\.png")
        self._numbers = sorted(color.keys() & depth.keys())
        if not self._numbers:
            raise DataError(
                f"{folder / 'results'} has {len(color)} images frame*.jpg and {len(depth)} "
                "depth*.png, and no number that has both. Check the names of the files."
            )
        self._files = [(color[k], depth[k]) for k in self._numbers]
        calibration = _calibration(folder)
        self.depth_scale = calibration.depth_scale
        stamps_ns = np.array(self._numbers, np.int64) * 10**9 // FRAME_RATE_HZ
        super().__init__(folder.resolve().name, calibration.camera, stamps_ns)

    def read(self, index: int) -> RawFrame:
        color_path, depth_path = self._files[index]
        return RawFrame(
            index,
            int(self.stamps_ns[index]),
            read_color(color_path),
            read_depth(depth_path),
            self.depth_scale,
            self.raw_camera,
        )

    def truth(self) -> Trajectory | None:
        path = self._folder / "traj.txt"
        if not path.is_file():
            return None
        poses = _poses(path)
        # One line per frame here, or one per number where some frames were removed.
        lines = np.array(self._numbers if len(poses) > len(self) else range(len(self)))
        known = lines < len(poses)
        return Trajectory(self.stamps_ns[known] / 1e9, poses[lines[known]])


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    matches = ((re.fullmatch(pattern, path.name), path) for path in folder.glob("*"))
    return {int(match[1]): path for match, path in matches if match}


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
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    return np.array([_pose(path, k, line) for k, line in enumerate(lines, 1)]).reshape(-1, 4, 4)


def _pose(path: Path, line_number: int, line: str) -> np.ndarray:
    try:
        T_world_camera = np.array([float(word) for word in line.split()]).reshape(4, 4)
    except ValueError:
        T_world_camera = np.full((4, 4), np.nan)
    if not _is_rigid(T_world_camera):
        raise DataError(
            f"{path}, line {line_number}: expected the 16 numbers of a rigid 4x4 camera-to-world "
            f"matrix by rows, found {line[:80]!r}."
        )
    return se3.orthonormalised(T_world_camera)


def _is_rigid(T: np.ndarray) -> bool:
    if not np.all(np.isfinite(T)):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0)
