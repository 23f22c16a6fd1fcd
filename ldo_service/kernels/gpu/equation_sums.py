"""Normal equations of direct alignment: launches of the kernels in `residuals`."""

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
        values: [height, width, 4].
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
        values: [7, count].
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
    """Return the 25 float32 values of a problem; the module `residuals` describes their layout.

    Args:
        T_camera_reference: Pose, [4, 4] or [3, 4].
        intrinsics: fx, fy, cx, cy of the frame, pixels.
        brightness: Gain, bias and noise of gray levels.
        depth_noise: Factor on the noise of depth, then its floor, growth and nearest depth.
        gate: Largest depth difference of a point and the frame, as a fraction of its depth.
        occlusion: Depth difference from which a point is hidden, as a fraction of the depth.
    """
    T = np.asarray(T_camera_reference)[:3].reshape(-1)
    return np.array([*T, *intrinsics, *brightness, *depth_noise, gate, occlusion], np.float32)


def strip_cells(cells: np.ndarray) -> np.ndarray:
    """Return the cell of each strip of 16 points, that of its middle point.

    Args:
        cells: Cell of each point, [N] uint8.
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
        cells: Cell of each strip of points on the device; None if no gradients by cell are needed.

    Returns:
        The sums, [51] float64. Then the gradients of the photometric and of the geometric residuals
        by cell, [64, 2, 8] float64; [0, 2, 8] without `cells`.
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
