"""Estimation of depth bias and vignetting from pairs of views, by least squares.

Depth. The surface points of the first view of a pair, transformed into the second view, must lie on
the tangent planes of its surface. The unknowns are the bias coefficients and the relative pose of
each pair. The reprojection errors of features constrain the poses too, because the image positions
of features have no bias.

Color. The log ratio of the brightness of one surface point in two views equals the difference of
log V at its two pixels, apart from a change of the exposure. The gain and the offset of this change
are unknowns of each pair.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import Camera, se3

from .correction import bias_basis, unbiased_depth, vignetting_basis
from .elimination import Block, Solution, solve, student_weight
from .views import SURFACE_STEP_M, SURFACE_STEP_RATIO, CalibrationView, ViewPair

# Depth noise of structured light, meters (Nguyen et al., 2012): s0 + s1 (z - z0)^2.
DEPTH_SIGMA = (0.0012, 0.0019, 0.4)
# Weight of a depth residual relative to a feature; low, because neighboring points share errors.
DEPTH_WEIGHT = 0.03
FEATURE_SIGMA_PX = 1.0
# Depth difference, as a fraction of depth, beyond which two points are on different surfaces.
MAX_STEP_RATIO = 0.08
# Inverse variances of the coefficients' prior around 0. The residuals are correlated but count as
# independent, so that they would outweigh a weaker prior.
DEPTH_PRIOR, VIGNETTING_PRIOR = 4e4, 5e1
# Gauss-Newton steps of each estimate. The next estimate starts from the result of this one.
DEPTH_ROUNDS, COLOR_ROUNDS = 3, 3
PAIRS_PER_PART = 16  # Pairs that one part of the work evaluates, about 40 ms.
BLOCK_STRIDE = 3  # Every third block along each axis is compared; neighbors are alike.
COLOR_STRIDE = 2  # Colors are compared at every second of these; neighbors have the same color.
MIN_COMMON = 200  # Minimum number of compared colors; a pair with fewer is skipped for vignetting.
CELLS = 8  # Cells of the image along its width.
GRAY_SIGMA = 1.0  # Minimum noise of a blurred color, gray levels.


@dataclass(frozen=True, slots=True)
class _Cloud:
    """Surface of a view after its depth is corrected by a given bias."""

    depth_m: np.ndarray  # [h, w]
    slope: np.ndarray  # [h, w] derivative of the depth with respect to the bias.
    normals: np.ndarray  # [h, w, 3] unit length.
    is_surface: np.ndarray  # [h, w] bool


@dataclass(frozen=True, slots=True)
class _Common:
    """Surface points that both views of a pair show, as flat indices into their blocks."""

    there: np.ndarray  # [N] in the first view.
    here: np.ndarray  # [N] in the second one.


@dataclass(frozen=True, slots=True)
class Estimate:
    """Depth bias and vignetting, with the relative poses that fit the bias."""

    depth_bias: np.ndarray  # [3] 1/m
    vignetting: np.ndarray  # [3, 3] channel by term
    pairs: list[ViewPair]  # Pairs with their relative poses, estimated jointly with the bias.
    depth_check: Solution  # Solution from the dense depth alone, without features.
    color_checks: list[Solution]  # One per channel; empty if too few colors were compared.

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
) -> Generator[None, None, Estimate]:
    """Estimate depth bias, relative poses and vignetting by Gauss-Newton steps.

    The generator yields after each part of the work, about 40 ms, so that the caller can spread the
    work over frames.

    Args:
        views: Views by number.
        pairs: Pairs of these views, in the order of time.
        depth_bias: Initial coefficients of the depth bias, [3].
        vignetting: Initial coefficients of the vignetting, [3, 3].
    """
    pairs = list(pairs)
    for _ in range(DEPTH_ROUNDS):
        blocks, _common = yield from _depth_blocks(views, pairs, depth_bias)
        found = solve(blocks, DEPTH_PRIOR, depth_bias)
        depth_bias = depth_bias + found.step
        pairs = [
            replace(p, T_second_first=se3.exp(x) @ p.T_second_first)
            for p, x in zip(pairs, found.own_steps, strict=True)
        ]
    blocks, common = yield from _depth_blocks(views, pairs, depth_bias)
    dense = [_without_features(block) for block in blocks]
    depth_check = solve(dense, DEPTH_PRIOR, depth_bias)
    checks, colors = [], []
    for channel in range(3):
        if len(pairs) > 2 * PAIRS_PER_PART:
            yield
        a, check = yield from _channel(views, pairs, common, channel, vignetting[channel])
        colors.append(a)
        checks += [] if check is None else [check]
    return Estimate(depth_bias, np.array(colors), pairs, depth_check, checks)


def _without_features(block: Block) -> Block:
    n = len(block.cells)
    return Block(block.shared[:n], block.own[:n], block.residual[:n], block.weight[:n], block.cells)


def _cloud(view: CalibrationView, coefficients: np.ndarray) -> _Cloud:
    u, v = view.pixels()
    depth_m = unbiased_depth(view.depth_m, bias_basis(u, v, view.camera) @ coefficients)
    points = view.camera.rays_at(u, v) * depth_m[..., None]
    normals, is_surface = np.zeros_like(points), np.zeros(depth_m.shape, bool)
    right, left = points[1:-1, 2:], points[1:-1, :-2]
    below, above = points[2:, 1:-1], points[:-2, 1:-1]
    n = np.cross(right - left, below - above)
    normals[1:-1, 1:-1] = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
    z = depth_m[1:-1, 1:-1]
    near = z > 0
    for neighbor in (right, left, below, above):
        step = abs(neighbor[..., 2] - z)
        near &= (neighbor[..., 2] > 0) & (step < SURFACE_STEP_RATIO * z + SURFACE_STEP_M)
    is_surface[1:-1, 1:-1] = near
    return _Cloud(depth_m, -(depth_m**2), normals, is_surface)


def _depth_blocks(
    views: Mapping[int, CalibrationView], pairs: Sequence[ViewPair], coefficients: np.ndarray
) -> Generator[None, None, tuple[list[Block], list[_Common]]]:
    clouds: dict[int, _Cloud] = {}
    blocks: list[Block] = []
    common: list[_Common] = []
    for i, p in enumerate(pairs):
        for number in (p.first, p.second):
            if number not in clouds:
                clouds[number] = _cloud(views[number], coefficients)
        block, points = _depth_block(
            views[p.first], clouds[p.first], clouds[p.second], p, coefficients
        )
        blocks.append(block)
        common.append(points)
        if i % PAIRS_PER_PART == PAIRS_PER_PART - 1:
            yield
    return blocks, common


def _depth_block(
    view: CalibrationView, there: _Cloud, here: _Cloud, pair: ViewPair, coefficients: np.ndarray
) -> tuple[Block, _Common]:
    u, v = view.pixels()
    rays = view.camera.rays_at(u, v).reshape(-1, 3)
    basis = bias_basis(u, v, view.camera).reshape(rays.shape)
    R, t = pair.T_second_first[:3, :3], pair.T_second_first[:3, 3]
    chosen = np.zeros(there.depth_m.shape, bool)
    chosen[::BLOCK_STRIDE, ::BLOCK_STRIDE] = there.is_surface[::BLOCK_STRIDE, ::BLOCK_STRIDE]
    a = np.flatnonzero(chosen)
    directions = rays[a] @ R.T
    points = directions * there.depth_m.reshape(-1)[a, None] + t
    b = _indices(points, view)
    is_seen = b >= 0
    depth_here = here.depth_m.reshape(-1)[b]
    is_seen &= here.is_surface.reshape(-1)[b]
    is_seen &= abs(points[:, 2] - depth_here) < MAX_STEP_RATIO * points[:, 2]
    a, b, points, directions = a[is_seen], b[is_seen], points[is_seen], directions[is_seen]
    z, n = here.depth_m.reshape(-1)[b], here.normals.reshape(-1, 3)[b]
    residual = np.sum((points - rays[b] * z[:, None]) * n, axis=1)
    s0, s1, z0 = DEPTH_SIGMA
    sigma_m = s0 + s1 * (points[:, 2] - z0) ** 2
    spread = max(1.48 * np.median(abs(residual / sigma_m)), 0.5) if len(residual) else 1.0
    slope_there, slope_here = there.slope.reshape(-1)[a], here.slope.reshape(-1)[b]
    shared = (np.sum(directions * n, axis=1) * slope_there)[:, None] * basis[a]
    shared -= (np.sum(rays[b] * n, axis=1) * slope_here)[:, None] * basis[b]
    own = np.c_[np.cross(points, n), n]
    weight = DEPTH_WEIGHT * student_weight(residual, sigma_m * spread)
    features = _feature_rows(view.camera, pair, coefficients)
    cells = _cells(b, here.depth_m.shape[1])
    block = Block(
        np.r_[shared, features.shared],
        np.r_[own, features.own],
        np.r_[residual, features.residual],
        np.r_[weight, features.weight],
        cells,
    )
    return block, _Common(a, b)


def _indices(points: np.ndarray, view: CalibrationView) -> np.ndarray:
    """Return the flat index of the block that each camera point [N, 3] projects into, or -1."""
    height, width = view.depth_m.shape
    is_ahead = points[:, 2] > 0.1
    safe = np.where(is_ahead[:, None], points, [0.0, 0.0, 1.0])
    column, row = np.floor((view.camera.project(safe) + 0.5) / view.block).astype(int).T
    inside = is_ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, row * width + column, -1)


def _cells(blocks: np.ndarray, width: int) -> np.ndarray:
    """Return the number of the cell of each block, given as a flat index into rows of `width`."""
    row, column = np.divmod(blocks, width)
    return (row * CELLS // width) * CELLS + column * CELLS // width


def _feature_rows(camera: Camera, pair: ViewPair, coefficients: np.ndarray) -> Block:
    """Return the linearized reprojection errors of the features in pixels; u and v alternate."""
    u, v = pair.pixels_first.T
    basis = bias_basis(u, v, camera)
    z = unbiased_depth(pair.depth_first_m, basis @ coefficients)
    R, t = pair.T_second_first[:3, :3], pair.T_second_first[:3, 3]
    directions = camera.rays_at(u, v) @ R.T
    points = directions * z[:, None] + t
    count = len(points)
    P = np.zeros((count, 2, 3))  # Derivative of the projection with respect to the point.
    P[:, 0, 0], P[:, 1, 1] = camera.fx / points[:, 2], camera.fy / points[:, 2]
    P[:, 0, 2] = -camera.fx * points[:, 0] / points[:, 2] ** 2
    P[:, 1, 2] = -camera.fy * points[:, 1] / points[:, 2] ** 2
    residual = (camera.project(points) - pair.pixels_second).reshape(-1)
    # Derivative of the point with respect to each rotation.
    turned = np.cross(np.eye(3), points[:, None])
    own = np.concatenate([P @ turned.transpose(0, 2, 1), P], axis=2).reshape(2 * count, 6)
    by_depth = (P @ directions[..., None])[..., 0] * -(z**2)[:, None]
    shared = (by_depth[..., None] * basis[:, None]).reshape(2 * count, -1)
    weight = student_weight(residual, FEATURE_SIGMA_PX)
    return Block(shared, own, residual, weight, np.zeros(0, int))


def _channel(
    views: Mapping[int, CalibrationView],
    pairs: Sequence[ViewPair],
    common: Sequence[_Common],
    channel: int,
    start: np.ndarray,
) -> Generator[None, None, tuple[np.ndarray, Solution | None]]:
    now, own = start, None
    samples = [
        sample
        for p, points in zip(pairs, common, strict=True)
        if (sample := _brightness(views[p.first], views[p.second], points, channel)) is not None
    ]
    found = None
    for _ in range(COLOR_ROUNDS):
        blocks = []
        for i, (level, log_ratio, basis, cells) in enumerate(samples):
            shared = -basis * level[:, None]
            gain = np.c_[level, np.ones(len(level))]
            residual = level * log_ratio + shared @ now
            rest = residual - np.median(residual) if own is None else residual + gain @ own[i]
            sigma = max(1.48 * float(np.median(abs(rest))), GRAY_SIGMA)
            blocks.append(Block(shared, gain, residual, student_weight(rest, sigma), cells))
        if not blocks:
            return start, None
        if len(blocks) > 2 * PAIRS_PER_PART:
            yield
        found = solve(blocks, VIGNETTING_PRIOR, now)
        now, own = now + found.step, found.own_steps
    return now, found


def _brightness(
    first: CalibrationView, second: CalibrationView, points: _Common, channel: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Compare one color channel of two views at their common points.

    Returns:
        Mean level [N], log ratio [N], difference of the basis functions [N, 3] and cell [N] of each
        point; None if there are fewer than MIN_COMMON points.
    """
    is_exposed = first.is_exposed.reshape(-1)[points.there]
    is_exposed &= second.is_exposed.reshape(-1)[points.here]
    a, b = points.there[is_exposed][::COLOR_STRIDE], points.here[is_exposed][::COLOR_STRIDE]
    if len(a) < MIN_COMMON:
        return None
    there = first.color.reshape(-1, 3)[a, channel].astype(np.float64)
    here = second.color.reshape(-1, 3)[b, channel].astype(np.float64)
    u, v = first.pixels()
    basis = vignetting_basis(u, v, first.camera).reshape(-1, 3)
    cells = _cells(b, first.depth_m.shape[1])
    return (there + here) / 2.0, np.log(here / there), basis[b] - basis[a], cells
