"""Sequences as ScanNet's SensReader exports them (Dai et al., CVPR 2017).

color/*.jpg depth/*.png           numbered images of different size; depth in millimetres
pose/*.txt                        optional: 4x4 camera to world by rows, -inf where unknown
intrinsic/intrinsic_color.txt     4x4 by rows, for colour images of their size
intrinsic/intrinsic_depth.txt     the same for depth
intrinsic/extrinsic_*.txt         optional: 4x4 from that camera to the sensor

ScanNet's exports are aligned: their extrinsics are the identity, though colour is larger than
depth (1296x968 and 640x480). Then colour is resampled to the depth image, whose every measurement
stays as it is. With other extrinsics, or where `SequenceOptions.register_depth` asks for it, depth
is registered into the colour camera. Poses are taken to be those of the depth camera; no aligned
export can tell.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import RawFrame, Trajectory, se3
from ldo_service.geometry.registration import resample_color
from ldo_service.geometry.sequence import Sequence

from .files import numbered, pair_by_number, read_intrinsics, read_trajectory, read_transform
from .images import first_size, read_color, read_depth
from .rig import Rig, SequenceOptions

DEPTH_SCALE = 1000.0  # units per metre in every export


class ScanNetSequence(Sequence):
    """Frames that have both colour and depth, in order of their numbers."""

    def __init__(self, folder: Path, options: SequenceOptions) -> None:
        self._folder = folder
        self._files = pair_by_number(
            numbered(folder / "color", r"(\d+)\.(?:jpg|jpeg|png)"),
            numbered(folder / "depth", r"(\d+)\.png"),
            folder,
        )
        sizes = first_size(self._files.color), first_size(self._files.depth)
        self._rig = options.over(_rig(folder / "intrinsic", *sizes))
        self._is_registering = options.register_depth or not self._rig.is_one_view
        camera = self._rig.color_camera if self._is_registering else self._rig.depth_camera
        super().__init__(folder.resolve().name, camera, self._files.stamps_ns)

    def read(self, index: int) -> RawFrame:
        color = read_color(self._files.color[index])
        depth = read_depth(self._files.depth[index])
        color, depth, depth_scale = self._on_one_grid(color, depth)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, color, depth, depth_scale, self.raw_camera)

    def truth(self) -> Trajectory | None:
        paths = [self._folder / "pose" / f"{path.stem}.txt" for path in self._files.color]
        depth = read_trajectory(self.stamps_ns, paths)
        if depth is None or not self._is_registering:
            return depth
        return replace(depth, T_world_camera=self._rig.T_world_color(depth.T_world_camera))

    def _on_one_grid(
        self, color: np.ndarray, depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Colour, depth and depth scale in the camera of this sequence."""
        if self._is_registering:
            return color, self._rig.register(depth.astype(np.float32) / DEPTH_SCALE), 1.0
        color, is_seen = resample_color(color, self._rig.color_camera, self._rig.depth_camera)
        if depth.shape == is_seen.shape:  # else RawFrame says what does not fit
            depth = np.where(is_seen, depth, np.uint16(0))
        return color, depth, DEPTH_SCALE


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
        raise DataError(f"{path} holds NaN or infinity, expected a rigid transform. Export again.")
    return T
