"""Sequences as ScanNet's SensReader exports them (Dai et al., CVPR 2017).

color/*.jpg depth/*.png           numbered images; sizes may differ; depth in millimeters
pose/*.txt                        optional: 4x4 camera to world by rows, -inf where unknown
intrinsic/intrinsic_color.txt     4x4 by rows, for the size of the color images
intrinsic/intrinsic_depth.txt     4x4 by rows, for the size of the depth images
intrinsic/extrinsic_color.txt     optional: 4x4 from the color camera to the sensor
intrinsic/extrinsic_depth.txt     optional: 4x4 from the depth camera to the sensor
label-filt/*.png                  optional: labels, see `scannet_labels`

ScanNet's own exports are aligned: their extrinsics are the identity. Their color images have
1296x968 pixels and their depth images 640x480. In an aligned export, color is resampled to the
depth image, and depth does not change. With other extrinsics, or with
`SequenceOptions.register_depth`, depth is registered to the color camera instead. Poses are assumed
to be those of the depth camera. In an aligned export, the poses of both cameras are equal.
"""

from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Trajectory, se3
from ldo_service.geometry.sequence import TrueLabels

from .files import (
    name_of,
    numbered,
    pair_by_number,
    read_intrinsics,
    read_trajectory,
    read_transform,
)
from .images import first_size, read_color, read_depth
from .rig import Rig, RigSequence, SequenceOptions
from .scannet_labels import ScanNetLabels

DEPTH_SCALE = 1000.0  # Units per meter in all exports.


class ScanNetSequence(RigSequence):
    """ScanNet sequence: frames with both color and depth, in the order of their numbers."""

    def __init__(self, folder: Path, options: SequenceOptions) -> None:
        """Open the sequence of a folder."""
        self._folder = folder
        self._files = pair_by_number(
            numbered(folder / "color", r"(\d+)\.(?:jpg|jpeg|png)"),
            numbered(folder / "depth", r"(\d+)\.png"),
            folder,
        )
        if not (folder / "intrinsic").is_dir():
            raise DataError(
                f"{folder} has color/ and depth/, but neither intrinsic/ (ScanNet) nor "
                "camera_intrinsic.json (Open3D, Redwood). Create camera_intrinsic.json with "
                "the 3x3 matrix column by column, such as "
                '{"width": 640, "height": 480, "intrinsic_matrix": [525, 0, 0, 0, 525, 0, 319.5, '
                "239.5, 1]}."
            )
        sizes = first_size(self._files.color), first_size(self._files.depth)
        rig = _rig(folder / "intrinsic", *sizes)
        super().__init__(name_of(folder), rig, self._files.stamps_ns, options)

    def read_images(self, index: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return color, depth, and its units per meter; see `RigSequence.read_images`."""
        color, depth = read_color(self._files.color[index]), read_depth(self._files.depth[index])
        return color, depth, DEPTH_SCALE

    def read_depth_poses(self) -> Trajectory | None:
        """Return the poses of the depth camera; see `RigSequence.read_depth_poses`."""
        paths = [self._folder / "pose" / f"{path.stem}.txt" for path in self._files.color]
        return read_trajectory(self.stamps_ns, paths)

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels, or None if the folder has no label images."""
        numbers, is_registering = self._files.numbers, self.registration == "reader"
        return ScanNetLabels(self._folder, numbers, self.rig, is_registering).read()


def _rig(folder: Path, color_size: tuple[int, int], depth_size: tuple[int, int]) -> Rig:
    color_camera = read_intrinsics(folder / "intrinsic_color.txt", 4, color_size)
    depth_camera = read_intrinsics(folder / "intrinsic_depth.txt", 4, depth_size)
    T_sensor_color, T_sensor_depth = (
        _extrinsics(folder / f"extrinsic_{name}.txt") for name in ("color", "depth")
    )
    return Rig(color_camera, depth_camera, se3.inverse(T_sensor_color) @ T_sensor_depth)


def _extrinsics(path: Path) -> np.ndarray:
    T = read_transform(path) if path.is_file() else np.eye(4)
    if T is None:
        raise DataError(
            f"{path} contains NaN or infinity, expected a rigid transform. Export it again."
        )
    return T
