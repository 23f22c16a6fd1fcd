"""Cells of a depth image as flat Gaussians that lie on the surface they were seen on."""

from math import log

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ldo_service.geometry import Camera, se3

from .cells import Cells
from .model import ROW

# Of the 0.3 px^2 that the renderer adds to every splat, taken back here: more is sharper, all of
# it leaves cracks between Gaussians of one pixel when they are seen from nearer.
LOW_PASS_TAKEN_BACK_PX2 = 0.2


def surfels(
    cells: Cells,
    color: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    T_map_camera: np.ndarray,
    *,
    sigma_per_spacing: float,
    thickness: float,
    max_stretch: float,
    opacity: float,
) -> np.ndarray:
    """Rows [M, 16] float32, one per cell: mean colour, mean depth, seen from here as a disc.

    Seen from this camera each is round, with a standard deviation of sigma_per_spacing times the
    side of its cell: along the slope of the surface it is longer by 1 / cos of the angle between
    normal and ray, at most `max_stretch`. Along the normal it is `thickness` times that.

    color [H, W, 3] uint8; depth_m [H, W] float32, > 0 in every cell; T_map_camera [4, 4]
    """
    rays = np.stack([(cells.u - camera.cx) / camera.fx, (cells.v - camera.cy) / camera.fy], -1)
    rays = np.concatenate([rays, np.ones((len(cells), 1))], axis=1)
    z = cells.mean_of(depth_m).astype(float)
    normals = normals_of(cells, rays, z, depth_m, camera)
    axes, cosines = slope_axes(normals, rays)

    sigma_px = np.sqrt((sigma_per_spacing * cells.size) ** 2 - LOW_PASS_TAKEN_BACK_PX2)
    sigma = sigma_px * z / np.sqrt(camera.fx * camera.fy)
    stretch = np.minimum(1 / np.maximum(cosines, 1e-6), max_stretch)
    rows = np.zeros((len(cells), ROW), np.float32)
    rows[:, 0:3] = se3.transform(T_map_camera, rays * z[:, None])
    rows[:, 3:6] = np.log(np.stack([sigma * stretch, sigma, sigma * thickness], -1))
    rows[:, 6:10] = _quaternions(T_map_camera[:3, :3] @ axes)
    rows[:, 10] = log(opacity / (1 - opacity))
    rows[:, 11:14] = cells.mean_of(color) / 255
    return rows


def normals_of(
    cells: Cells, rays: np.ndarray, z: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> np.ndarray:
    """Unit surface normals [M, 3], camera frame, away from the camera.

    On a plane n . p = d the inverse depth is affine in the pixel, 1 / z = n . ray / d, so its
    slopes hold the normal. Where 5x5 pixels are not one smooth measured surface: the ray.
    """
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-6), 0).astype(np.float32)
    window = np.ones((5, 5), np.uint8)
    low, high = cv2.erode(inverse, window), cv2.dilate(inverse, window)
    middle = tuple(
        _two_from_edges(start + cells.size // 2, length)
        for start, length in zip((cells.row, cells.column), depth_m.shape, strict=True)
    )
    u_slope, v_slope = (
        cv2.Sobel(inverse, cv2.CV_32F, *order, ksize=5, scale=1 / 128)[middle].astype(float)
        for order in ((1, 0), (0, 1))
    )
    n_x, n_y = camera.fx * u_slope, camera.fy * v_slope
    normals = np.stack([n_x, n_y, 1 / z - n_x * rays[:, 0] - n_y * rays[:, 1]], axis=-1)
    smooth = (low[middle] > 0) & (high[middle] < 1.15 * low[middle])
    return _unit(np.where(smooth[:, None], normals, rays))


def slope_axes(normals: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [M, 3, 3] with columns: down the slope, across it, normal; and |cos| [M] of the
    angle between normal and ray. All vectors are [M, 3] in one frame."""
    unit_rays = _unit(rays)
    cosines = np.sum(normals * unit_rays, axis=1, keepdims=True)
    slope = unit_rays - cosines * normals
    facing = np.linalg.norm(slope, axis=1, keepdims=True) < 1e-3  # any direction will do
    x_or_y = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    slope = _unit(np.where(facing, np.cross(normals, x_or_y), slope))
    return np.stack([slope, np.cross(normals, slope), normals], axis=-1), np.abs(cosines[:, 0])


def _two_from_edges(index: np.ndarray, length: int) -> np.ndarray:
    """Pixel indices moved to where the 5x5 window of a slope lies in the image, if it can."""
    return index.clip(min(2, length // 2), max(length - 3, length // 2))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _quaternions(R: np.ndarray) -> np.ndarray:
    """Quaternions [M, 4] wxyz of rotations [M, 3, 3]."""
    if len(R) == 0:  # SciPy refuses an empty batch in some of the versions we admit
        return np.zeros((0, 4))
    return Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]
