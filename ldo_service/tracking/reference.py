"""What a frame is aligned to: the surface points of a keyframe. `ldo_service.geometry`."""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.kernels import _align

from .pyramid import Level, Pyramid


@dataclass(frozen=True, slots=True)
class Reference:
    """Points [7, N] float32 of each level, the finest first.

    Rows: x y z in m in the reference camera, grey level, and a normal (0 0 0 where none).
    `median_depth_m` is the scale of the scene, 1 where nothing was measured.
    """

    points: tuple[np.ndarray, ...]
    median_depth_m: float


def build_reference(pyramid: Pyramid, left_out: np.ndarray | None = None) -> Reference:
    """Of the pixels with depth, but for those `left_out` [H, W] bool at working resolution."""
    levels = (_without(level, left_out) for level in pyramid.levels)
    points = tuple(_level_points(level, i) for i, level in enumerate(levels))
    depth_m = points[0][2]
    return Reference(points, float(np.median(depth_m)) if depth_m.size else 1.0)


def _without(level: Level, left_out: np.ndarray | None) -> Level:
    if left_out is None or not left_out.any():
        return level
    size = level.camera.width, level.camera.height
    share = cv2.resize(left_out.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    texels = level.texels.copy()
    texels[..., 3][share > 0] = 0
    return Level(texels, level.camera)


def _level_points(level: Level, index: int) -> np.ndarray:
    smooth = np.asarray(cv2.medianBlur(np.ascontiguousarray(level.depth_m), 3), np.float32)
    radius_px = max(1, 3 - index)  # about the same angle on every level
    normals = _align.normals(smooth, level.intrinsics, radius_px)
    return _align.points(level.texels, normals, level.intrinsics)
