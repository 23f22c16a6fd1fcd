"""Normal equations of direct alignment, summed by the GPU kernels of the module `residuals`."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import residuals
from .arrays import Arrays
from .blending import ONE_WARP
from .plane_rendering import FOUR_WARPS, programs_for

SUMS = 51  # The module `residuals` describes their order.
STRIP, STRIP_ROWS, CELLS = 16, 14, 64
POINT_LANES = 128  # Points of a program; the registers allow no more.
# The compiler would stop at 128 registers without `maxnreg`, and spill.
SUMMING = {**ONE_WARP, "maxnreg": 168}
SUM_LANES, STRIP_LANES = 256, 128


@dataclass(frozen=True, eq=False, slots=True)
class Texels:
    """Texels of an image on the device.

    Attributes:
        values: Gray level, its derivatives along u and v, and depth, [height, width, 4].
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """

    values: Any
    width: int
    height: int


@dataclass(frozen=True, eq=False, slots=True)
class Points:
    """Reference points on the device.

    Attributes:
        values: Coordinates (3), gray level and normal (3) of each point, [7, count].
        count: Number of points.
    """

    values: Any
    count: int


def problem_of(
    T_camera_reference: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    brightness: tuple[float, float, float],
    depth_noise: tuple[float, float, float, float],
    gate: float,
    occlusion: float,
) -> np.ndarray:
    """Return the input of the alignment kernels, [25] float32; see the module `residuals`.

    Args:
        T_camera_reference: Transform from the reference to the camera, [4, 4] or [3, 4].
        intrinsics: fx, fy, cx, cy of the frame, pixels.
        brightness: Gain, bias and noise of gray levels.
        depth_noise: Values (scale, floor, growth, nearest). The noise at a depth z in meters is
            scale * (floor + growth * (z - nearest)^2), a standard deviation in meters.
        gate: Largest depth difference between a point and the frame, as a fraction of the depth of
            the point.
        occlusion: Depth difference beyond which a point is hidden behind the measured surface, as a
            fraction of the measured depth.
    """
    T = np.asarray(T_camera_reference)[:3].reshape(-1)
    return np.array([*T, *intrinsics, *brightness, *depth_noise, gate, occlusion], np.float32)


def strip_cells(cells: np.ndarray) -> np.ndarray:
    """Return the image cell of each strip of 16 consecutive points.

    The cell of a strip is the cell of its middle point.

    Args:
        cells: Number of the image cell of each point, [N] uint8.
    """
    middles = np.arange(0, len(cells), STRIP) + STRIP // 2
    return cells[np.minimum(middles, len(cells) - 1)]


def sum_equations(
    arrays: Arrays, points: Points, texels: Texels, problem: np.ndarray, cells: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Sum the normal equations of all points, in a fixed order.

    Args:
        arrays: Arrays of the device.
        points: Reference points.
        texels: Texels of the frame.
        problem: Pose, intrinsics and settings, [25] float32; see `residuals`.
        cells: Output of `strip_cells`, on the device; None if no gradients per image cell are
            needed.

    Returns:
        The sums, [51] float64, in the order that `residuals` describes. Then the gradients of the
        photometric and of the geometric residuals per image cell, [64, 2, 8] float64. Without
        `cells`, their shape is [0, 2, 8].
    """
    by_cell = np.zeros((0 if cells is None else CELLS, 2, 8))
    n = points.count
    if n == 0:
        return np.zeros(SUMS), by_cell
    grid, n_strips = programs_for(n, POINT_LANES), -(-n // STRIP)
    sums = arrays.empty((SUMS, *grid), np.float32)
    strips = sums if cells is None else arrays.empty((STRIP_ROWS, n_strips), np.float32)
    residuals.sum_residuals[grid](
        points.values,
        n,
        texels.values,
        texels.width,
        texels.height,
        arrays.upload(problem),
        grid[0],
        sums,
        strips,
        WITH_STRIPS=cells is not None,
        BLOCK=POINT_LANES,
        **SUMMING,
    )
    total = arrays.empty((SUMS,), np.float64)
    residuals.add_programs[(SUMS,)](sums, grid[0], total, LANES=SUM_LANES, **ONE_WARP)
    if cells is not None:
        gradients = arrays.empty((CELLS, STRIP_ROWS), np.float64)
        residuals.add_strips[(CELLS,)](
            strips, cells, n_strips, gradients, LANES=STRIP_LANES, **FOUR_WARPS
        )
        found = arrays.download(gradients)
        by_cell[:, 0], by_cell[:, 1, :6] = found[:, :8], found[:, 8:]
    return arrays.download(total), by_cell
