"""Comparison of two calibration views: depth, features and colors as linearized equations.

The equations of depth and features have two kinds of unknowns. All pairs of views share the
coefficients of the depth bias (columns `BIAS`) and the times of the shutter (columns `TIMES`). Each
pair has a relative pose of its own. The camera records the rows of color and depth at different
times. The equations move the points between these times with the velocity of the camera.
Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.kernels import _surfaces

from .correction import (
    BIAS_TERMS,
    VIGNETTING_TERMS,
    bias_basis,
    unbiased_depth,
    vignetting_basis,
)
from .elimination import Block, student_weight
from .views import (
    SURFACE_STEP_M,
    SURFACE_STEP_RATIO,
    CalibrationView,
    ViewPair,
    block_centers,
)

TIME_TERMS = 3  # Readout of color, readout of depth and delay of depth.
BIAS = slice(0, BIAS_TERMS)
TIMES = slice(BIAS_TERMS, BIAS_TERMS + TIME_TERMS)
# Depth noise of structured light, meters (Nguyen et al., 2012): s0 + s1 (z - z0)^2.
DEPTH_SIGMA = (0.0012, 0.0019, 0.4)
# Weight of a depth residual relative to a feature; low, because neighboring points share errors.
DEPTH_WEIGHT = 0.12
FEATURE_SIGMA_PX = 1.0
# Depth difference, as a fraction of depth, beyond which two points are on different surfaces.
MAX_STEP_RATIO = 0.08
BLOCK_STRIDE = 3  # Every third block along each axis is compared; neighbors are alike.
COLOR_STRIDE = 2  # Colors are compared at every second common point; neighbors are alike.
MIN_COMMON = 200  # Minimum number of compared colors; a pair with fewer is skipped for vignetting.
CELLS = 8  # Cells of the image along its width.
COLUMNS = TIMES.stop + 7  # Shared unknowns, relative pose and residual.


@dataclass(frozen=True, slots=True)
class CommonPoints:
    """Surface points that both views of a pair show.

    A point is given by the block of pixels that shows it in each view. The blocks of a view are
    numbered row by row.
    """

    in_first: np.ndarray  # [N] int64, blocks of the first view.
    in_second: np.ndarray  # [N] int64, blocks of the second view.


@dataclass(frozen=True, slots=True)
class ComparedPair:
    """Pair of views, and the shared unknowns at which its equations are linearized."""

    first: CalibrationView  # View `pair.first`, whose depth is used.
    second: CalibrationView  # View `pair.second`.
    pair: ViewPair
    # [6]: coefficients of the depth bias [3], 1/m; then readout of color, readout of depth and
    # delay of depth [3], seconds.
    shared: np.ndarray


@lru_cache(maxsize=2)
def block_grid(camera: Camera, block: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rays and basis functions at the centers of the h x w blocks of a view.

    The result has three arrays [h w, 3]: the viewing rays, the values of the three basis functions
    of the depth bias, and those of the three basis functions of the vignetting.
    """
    u, v = block_centers(camera, block)
    bases = bias_basis(u, v, camera), vignetting_basis(u, v, camera)
    rays, bias, vignetting = (b.reshape(-1, 3) for b in (camera.rays_at(u, v), *bases))
    return rays, bias, vignetting


def view_surface(view: CalibrationView, coefficients: np.ndarray) -> np.ndarray:
    """Return a surface point and a unit normal for each of the h x w blocks of a view, [h w, 6].

    Both are in the camera frame, the point in meters. The normal is 0 where the block and its four
    neighbors do not belong to one surface.

    Args:
        view: The view.
        coefficients: Coefficients b1, b2, b3 of the depth bias, [3], in 1/m. The bias is removed
            from the depth.
    """
    rays, basis, _ = block_grid(view.camera, view.block)
    bias = (basis @ coefficients).reshape(view.depth_m.shape)
    depth_m = unbiased_depth(view.depth_m.astype(np.float64), bias)
    result = np.empty((len(rays), 6))
    _surfaces.surfaces(depth_m, rays, SURFACE_STEP_RATIO, SURFACE_STEP_M, result)
    return result


def depth_block(
    compared: ComparedPair, surface_first: np.ndarray, surface_second: np.ndarray
) -> tuple[Block, CommonPoints]:
    """Compare the surfaces of both views of a pair.

    Each point of the first view is transformed to the second view. Its residual is its distance in
    meters from the tangent plane of the surface of the second view.

    Args:
        compared: The pair.
        surface_first: Points and normals of the first view, see `view_surface`, [h w, 6].
        surface_second: Points and normals of the second view, [h w, 6].

    Returns:
        The linearized residuals, and the points that both views show.
    """
    view, (_, depth_readout_s, delay_s) = compared.first, compared.shared[TIMES].tolist()
    height, width = view.depth_m.shape
    most = -(-height // BLOCK_STRIDE) * -(-width // BLOCK_STRIDE)
    rows, depths, indices = np.empty((most, COLUMNS)), np.empty(most), np.empty((most, 2), np.int64)
    count = _surfaces.compare(
        surface_first,
        surface_second,
        block_grid(view.camera, view.block)[1],
        compared.pair.T_second_first,
        view.velocity,
        compared.second.velocity,
        (depth_readout_s, delay_s),
        (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy),
        view.block,
        width,
        BLOCK_STRIDE,
        MAX_STEP_RATIO,
        rows,
        depths,
        indices,
    )
    rows, depths, (a, b) = rows[:count], depths[:count], indices[:count].T
    s0, s1, z0 = DEPTH_SIGMA
    sigma_m, residual = s0 + s1 * (depths - z0) ** 2, rows[:, -1]
    spread = max(1.48 * np.median(abs(residual / sigma_m)), 0.5) if count else 1.0
    weight = DEPTH_WEIGHT * student_weight(residual, sigma_m * spread)
    return Block(rows, weight, _cells(b, width)), CommonPoints(a, b)


def _cells(blocks: np.ndarray, width: int) -> np.ndarray:
    """Return the number of the cell of each block, given as a flat index into rows of `width`."""
    row, column = np.divmod(blocks, width)
    return (row * CELLS // width) * CELLS + column * CELLS // width


def feature_block(compared: ComparedPair, surface_first: np.ndarray) -> Block:
    """Return the linearized reprojection errors of the features, in pixels.

    Each feature has two successive rows: the error in u, and the error in v.

    Args:
        compared: The pair.
        surface_first: Points and normals of the first view, in the frame of its camera, [h w, 6];
            see `view_surface`.
    """
    view, pair, camera = compared.first, compared.pair, compared.first.camera
    rows = np.empty((2 * len(pair.depth_first_m), COLUMNS))
    _surfaces.compare_features(
        surface_first,
        pair.pixels_first,
        pair.depth_first_m,
        pair.pixels_second,
        pair.T_second_first,
        view.velocity,
        compared.second.velocity,
        compared.shared[BIAS].tolist(),
        compared.shared[TIMES].tolist(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        (camera.width, camera.height),
        view.block,
        rows,
    )
    return Block(rows, student_weight(rows[:, -1], FEATURE_SIGMA_PX), np.zeros(0, int))


def color_block(
    first: CalibrationView, second: CalibrationView, points: CommonPoints
) -> Block | None:
    """Compare the colors of two views at their common points.

    Returns:
        The linearized measurements of the three color channels, all with weight 1. The unknowns of
        each channel are the vignetting, which all pairs of views share, and gain and offset of the
        exposure, which belong to this pair alone. The result is None if fewer than MIN_COMMON
        points are compared.
    """
    is_exposed = first.is_exposed.reshape(-1)[points.in_first]
    is_exposed &= second.is_exposed.reshape(-1)[points.in_second]
    a = points.in_first[is_exposed][::COLOR_STRIDE]
    b = points.in_second[is_exposed][::COLOR_STRIDE]
    if len(a) < MIN_COMMON:
        return None
    there = first.color.reshape(-1, 3)[a].T.astype(np.float64)
    here = second.color.reshape(-1, 3)[b].T.astype(np.float64)
    _, _, basis = block_grid(first.camera, first.block)
    level = (there + here) / 2.0
    rows = np.empty((3, len(a), VIGNETTING_TERMS + 3))
    rows[..., :3] = level[..., None] * (basis[a] - basis[b])
    rows[..., 3], rows[..., 4] = level, 1.0
    rows[..., 5] = level * np.log(here / there)
    return Block(rows, np.ones(level.shape), _cells(b, first.depth_m.shape[1]))
