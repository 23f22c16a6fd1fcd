"""Estimation of depth bias and vignetting from pairs of views, by least squares.

Depth. The surface points of the first view of a pair, transformed into the second view, must lie on
the tangent planes of its surface. The unknowns are the bias coefficients and the relative pose of
each pair. The reprojection errors of features constrain the poses too, because the image positions
of features have no bias. Residual and derivatives contain the same noisy depths. A derivative at
the mean of both depths has no noise in common with the residual, which contains their difference:
otherwise the noise of a Kinect would shift the y^2 coefficient by up to 0.01/m.

Color. The log ratio of the brightness of one surface point in two views equals the difference of
log V at its two pixels, apart from a change of the exposure. The gain and the offset of this change
are unknowns of each pair.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ldo_service.geometry import Camera, se3
from ldo_service.kernels import _surfaces

from .correction import (
    BIAS_TERMS,
    VIGNETTING_TERMS,
    bias_basis,
    unbiased_depth,
    vignetting_basis,
)
from .elimination import (
    Block,
    Check,
    Reduced,
    check,
    covariance,
    solve,
    student_weight,
)
from .views import (
    SURFACE_STEP_M,
    SURFACE_STEP_RATIO,
    CalibrationView,
    ViewPair,
    block_centers,
    reprojection,
)

# Depth noise of structured light, meters (Nguyen et al., 2012): s0 + s1 (z - z0)^2.
DEPTH_SIGMA = (0.0012, 0.0019, 0.4)
# Weight of a depth residual relative to a feature; low, because neighboring points share errors.
DEPTH_WEIGHT = 0.12
FEATURE_SIGMA_PX = 1.0
# Depth difference, as a fraction of depth, beyond which two points are on different surfaces.
MAX_STEP_RATIO = 0.08
# Inverse variances of the coefficients' prior around 0: 0.01/m for the depth bias, the
# size of that of an Xtion.
DEPTH_PRIOR, VIGNETTING_PRIOR = 1e4, 5e1
# Gauss-Newton steps of the first estimate, and of later ones, which start from its result.
FIRST_ROUNDS, LATER_ROUNDS = 3, 2
COLOR_ROUNDS = 2
VIEW_GROUPS = 5  # Groups of views for the jackknife.
BLOCK_STRIDE = 3  # Every third block along each axis is compared; neighbors are alike.
COLOR_STRIDE = 2  # Colors are compared at every second of these; neighbors have the same color.
MIN_COMMON = 200  # Minimum number of compared colors; a pair with fewer is skipped for vignetting.
CELLS = 8  # Cells of the image along its width.
GRAY_SIGMA = 1.0  # Minimum noise of a blurred color, gray levels.
# Work of the steps below; a unit is about 1 ms on one core of an AMD EPYC.
SURFACE_WORK, PAIR_WORK, COLOR_PAIR_WORK, COLOR_ROUND_WORK = 0.3, 0.5, 0.3, 0.3


@dataclass(frozen=True, slots=True)
class _Common:
    """Surface points that both views of a pair show, as indices into their blocks."""

    there: np.ndarray  # [N] in the first view.
    here: np.ndarray  # [N] in the second one.


@dataclass(frozen=True, slots=True)
class Estimate:
    """Depth bias and vignetting, with the relative poses that fit the bias."""

    depth_bias: np.ndarray  # [3] 1/m
    depth_bias_covariance: np.ndarray  # [3, 3] 1/m^2
    vignetting: np.ndarray  # [3, 3] channel by term
    pairs: list[ViewPair]  # Pairs with their relative poses, estimated jointly with the bias.
    depth_check: Check  # Held-out residuals of the dense depth alone, without features.
    color_checks: list[Check]  # One per channel; empty if too few colors were compared.

    @property
    def is_finite(self) -> bool:
        """True if no coefficient is NaN or infinite, as degenerate pairs can make it."""
        return bool(np.isfinite(self.depth_bias).all() and np.isfinite(self.vignetting).all())

    @property
    def depth_ratio(self) -> float:
        """Held-out depth residual with the bias removed, divided by the one of the raw depth."""
        return self.depth_check.residual_ratio

    @property
    def color_ratio(self) -> float:
        """Held-out color residual with vignetting removed, divided by the one of the raw color."""
        without = sum(check.rms_without for check in self.color_checks)
        return sum(check.rms_with for check in self.color_checks) / without if without else 1.0


def estimate(
    views: Mapping[int, CalibrationView],
    pairs: Sequence[ViewPair],
    depth_bias: np.ndarray,
    vignetting: np.ndarray,
) -> Generator[float, None, Estimate]:
    """Estimate depth bias, relative poses and vignetting by Gauss-Newton steps.

    The generator yields after each small step, such as the comparison of one pair, so that the
    caller can spread the work over frames. It yields the amount of work, about 1 per millisecond.

    Args:
        views: Views by number.
        pairs: Pairs of these views, in the order of time.
        depth_bias: Initial coefficients of the depth bias, [3].
        vignetting: Initial coefficients of the vignetting, [3, 3].
    """
    linear = yield from _linearized(views, pairs, depth_bias)
    for _ in range((LATER_ROUNDS if depth_bias.any() else FIRST_ROUNDS) - 1):
        step = solve(linear.reduced, DEPTH_PRIOR, depth_bias)
        depth_bias, pairs = depth_bias + step, _moved(pairs, linear, step)
        linear = yield from _linearized(views, pairs, depth_bias)
    before, step = depth_bias, solve(linear.reduced, DEPTH_PRIOR, depth_bias)
    depth_bias, pairs = depth_bias + step, _moved(pairs, linear, step)
    uncertainty = covariance(linear.reduced, DEPTH_PRIOR, before, _pairs_of_views(pairs))
    dense = [Reduced.of(block.products, BIAS_TERMS) for block in linear.dense]
    (depth_check,) = yield from check(linear.dense, dense, DEPTH_PRIOR, before)
    colors, color_checks = yield from _vignetting(views, pairs, linear.common, vignetting)
    return Estimate(depth_bias, uncertainty, colors, pairs, depth_check, color_checks)


def _pairs_of_views(pairs: Sequence[ViewPair]) -> list[set[int]]:
    """Return groups of the indices of all pairs that use any of some successive views.

    Pairs that share a view share its errors, so the jackknife leaves out whole views.
    """
    numbers = sorted({number for p in pairs for number in (p.first, p.second)})
    groups = np.array_split(numbers, min(VIEW_GROUPS, len(numbers)))
    return [
        {i for i, p in enumerate(pairs) if p.first in group or p.second in group}
        for group in map(set, groups)
    ]


@lru_cache(maxsize=2)
def _grid(camera: Camera, block: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rays, bias basis and vignetting basis of the blocks of a view, each [h w, 3]."""
    u, v = block_centers(camera, block)
    bases = bias_basis(u, v, camera), vignetting_basis(u, v, camera)
    rays, bias, vignetting = (b.reshape(-1, 3) for b in (camera.rays_at(u, v), *bases))
    return rays, bias, vignetting


# --- depth ----------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class _Linearized:
    """Equations of all pairs, linearized at given coefficients and poses."""

    reduced: list[Reduced]  # Dense depth and features.
    dense: list[Block]
    common: list[_Common]


def _linearized(
    views: Mapping[int, CalibrationView], pairs: Sequence[ViewPair], coefficients: np.ndarray
) -> Generator[float, None, _Linearized]:
    surfaces: dict[int, np.ndarray] = {}
    linear = _Linearized([], [], [])
    for p in pairs:
        view = views[p.first]
        for number in (p.first, p.second):
            if number not in surfaces:
                surfaces[number] = _surface(views[number], coefficients)
                yield SURFACE_WORK
        block, points = _depth_block(view, surfaces[p.first], surfaces[p.second], p)
        features = _feature_block(view.camera, p, coefficients)
        linear.reduced.append(Reduced.of(block.products + features.products, BIAS_TERMS))
        linear.dense.append(block)
        linear.common.append(points)
        yield PAIR_WORK
    return linear


def _moved(pairs: Sequence[ViewPair], linear: _Linearized, step: np.ndarray) -> list[ViewPair]:
    """Return the pairs with the relative poses after a step [3] of the coefficients."""
    return [
        p.at(se3.exp(reduced.own_step(step)) @ p.T_second_first)
        for p, reduced in zip(pairs, linear.reduced, strict=True)
    ]


def _surface(view: CalibrationView, coefficients: np.ndarray) -> np.ndarray:
    """Return points and normals [h w, 6] of a view; see `_surfaces.surfaces`."""
    rays, basis, _ = _grid(view.camera, view.block)
    bias = (basis @ coefficients).reshape(view.depth_m.shape)
    depth_m = unbiased_depth(view.depth_m.astype(np.float64), bias)
    result = np.empty((len(rays), 6))
    _surfaces.surfaces(depth_m, rays, SURFACE_STEP_RATIO, SURFACE_STEP_M, result)
    return result


def _depth_block(
    view: CalibrationView, there: np.ndarray, here: np.ndarray, pair: ViewPair
) -> tuple[Block, _Common]:
    """Compare the surfaces of both views of a pair; see `_surfaces.compare`."""
    height, width = view.depth_m.shape
    most = -(-height // BLOCK_STRIDE) * -(-width // BLOCK_STRIDE)
    rows, depths, indices = np.empty((most, 10)), np.empty(most), np.empty((most, 2), np.int64)
    count = _surfaces.compare(
        there,
        here,
        _grid(view.camera, view.block)[1],
        pair.T_second_first,
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
    return Block(rows, weight, _cells(b, width)), _Common(a, b)


def _cells(blocks: np.ndarray, width: int) -> np.ndarray:
    """Return the number of the cell of each block, given as a flat index into rows of `width`."""
    row, column = np.divmod(blocks, width)
    return (row * CELLS // width) * CELLS + column * CELLS // width


def _feature_block(camera: Camera, pair: ViewPair, coefficients: np.ndarray) -> Block:
    """Return the linearized reprojection errors of the features in pixels; u and v alternate."""
    u, v = pair.pixels_first.T
    basis = bias_basis(u, v, camera)
    z = unbiased_depth(pair.depth_first_m, basis @ coefficients)
    errors, by_point, points = reprojection(
        camera, pair.T_second_first, camera.rays_at(u, v) * z[:, None], pair.pixels_second
    )
    # A point on a ray moves by -z^2 ray = -z point per unit of the bias.
    turned = points - pair.T_second_first[:3, 3]
    by_bias = -(by_point[..., 3:] @ turned[..., None]) * z[:, None, None] * basis[:, None]
    rows = np.concatenate([by_bias, by_point, errors[..., None]], axis=-1).reshape(-1, 10)
    return Block(rows, student_weight(rows[:, -1], FEATURE_SIGMA_PX), np.zeros(0, int))


# --- color ----------------------------------------------------------------------------------------
def _vignetting(
    views: Mapping[int, CalibrationView],
    pairs: Sequence[ViewPair],
    common: Sequence[_Common],
    start: np.ndarray,
) -> Generator[float, None, tuple[np.ndarray, list[Check]]]:
    """Estimate the coefficients of the vignetting, [3, 3], and check each channel."""
    compared: list[Block] = []
    for p, points in zip(pairs, common, strict=True):
        block = _color_block(views[p.first], views[p.second], points)
        if block is not None:
            compared.append(block)
        yield COLOR_PAIR_WORK
    if not compared:
        return start, []
    now, nothing, reduced = start, np.zeros_like(start), []
    for _ in range(COLOR_ROUNDS):
        own_steps = [r.own_step(now) for r in reduced] or [None] * len(compared)
        reduced = []
        for block, own in zip(compared, own_steps, strict=True):
            weight = _color_weight(block.rows, now, own)
            reduced.append(Reduced.of(replace(block, weight=weight).products, VIGNETTING_TERMS))
            yield COLOR_ROUND_WORK
        now = solve(reduced, VIGNETTING_PRIOR, nothing)
    checks = yield from check(compared, reduced, VIGNETTING_PRIOR, nothing)
    return now, checks


def _color_weight(rows: np.ndarray, now: np.ndarray, own: np.ndarray | None) -> np.ndarray:
    """Return the weights [3, N] of the rows [3, N, 6] of a pair by their residuals.

    Args:
        rows: Derivatives by vignetting, gain and offset, and the residual without vignetting.
        now: Coefficients of the vignetting, [3, 3].
        own: Gain and offset of the pair, [3, 2]; None if unknown.
    """
    rest = (rows[..., :3] @ now[..., None])[..., 0] + rows[..., 5]
    if own is None:
        rest = rest - np.median(rest, axis=1, keepdims=True)
    else:
        rest = rest + (rows[..., 3:5] @ own[..., None])[..., 0]
    sigma = np.maximum(1.48 * np.median(abs(rest), axis=1, keepdims=True), GRAY_SIGMA)
    return student_weight(rest, sigma)


def _color_block(first: CalibrationView, second: CalibrationView, points: _Common) -> Block | None:
    """Compare the colors of two views at their common points.

    Returns:
        A block of the three channels, whose weights are 1. Its own unknowns are gain and offset.
        None if there are fewer than MIN_COMMON points.
    """
    is_exposed = first.is_exposed.reshape(-1)[points.there]
    is_exposed &= second.is_exposed.reshape(-1)[points.here]
    a, b = points.there[is_exposed][::COLOR_STRIDE], points.here[is_exposed][::COLOR_STRIDE]
    if len(a) < MIN_COMMON:
        return None
    there = first.color.reshape(-1, 3)[a].T.astype(np.float64)
    here = second.color.reshape(-1, 3)[b].T.astype(np.float64)
    _, _, basis = _grid(first.camera, first.block)
    level = (there + here) / 2.0
    rows = np.empty((3, len(a), VIGNETTING_TERMS + 3))
    rows[..., :3] = level[..., None] * (basis[a] - basis[b])
    rows[..., 3], rows[..., 4] = level, 1.0
    rows[..., 5] = level * np.log(here / there)
    return Block(rows, np.ones(level.shape), _cells(b, first.depth_m.shape[1]))
