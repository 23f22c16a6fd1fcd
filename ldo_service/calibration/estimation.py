"""Estimation of depth bias, shutter timing and vignetting from pairs of views, by least squares.

Depth: The surface points of the first view of a pair are transformed into the second view. There,
they must lie on the tangent planes of the second view's surface. The unknowns are the coefficients
of the depth bias, the three times of `ShutterTiming`, and the relative pose of each pair. The
reprojection errors of features constrain the poses too, because depth bias does not move features
in the image.

Shutter: The camera moves while a frame is recorded. A row that is recorded earlier or later than
the middle row of color is therefore displaced. Bias and shutter times are estimated together.
Otherwise, the distortion by a rolling shutter would be mistaken for depth bias.

Noise: The residual is the difference of two noisy depths. Its derivatives are computed at the mean
of both depths, because the noise of the mean is independent of the noise of the difference. With
derivatives at one of the depths, the noise of a Kinect would shift the coefficient of y^2 by up to
0.01/m.

Color: The two views of a pair show one surface point at two pixels. The log ratio of its brightness
in both views equals the difference of log V at these pixels. V is the vignetting. A change of the
exposure between the views adds a gain and an offset, which are unknowns of each pair.

`CameraCorrection` defines depth bias and vignetting.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ldo_service.geometry import se3

from .comparison import (
    BIAS,
    TIMES,
    CommonPoints,
    ComparedPair,
    color_block,
    depth_block,
    feature_block,
    view_surface,
)
from .correction import BIAS_TERMS, VIGNETTING_TERMS, CameraCorrection
from .elimination import (
    Block,
    HeldOutResiduals,
    Reduced,
    check,
    covariance,
    solve,
    student_weight,
)
from .outlines import Extrinsics, extrinsics
from .views import CalibrationView, ViewPair

# Inverse variances of the prior of the coefficients around 0. For the depth bias, the standard
# deviation is 0.01/m, the size of the bias of an Xtion.
DEPTH_PRIOR, VIGNETTING_PRIOR = 1e4, 5e1
# Prior of the times of the shutter, seconds: a readout of color of 20 ms, a readout of depth that
# differs from it by 10 ms, and a delay of 10 ms (standard deviations around 0).
TIME_COMBINATIONS = np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
TIME_SIGMAS_S = np.array([0.02, 0.01, 0.01])
SHARED_PRIOR = np.zeros((TIMES.stop, TIMES.stop))
SHARED_PRIOR[BIAS, BIAS] = DEPTH_PRIOR * np.eye(BIAS_TERMS)
SHARED_PRIOR[TIMES, TIMES] = TIME_COMBINATIONS.T @ (TIME_COMBINATIONS / TIME_SIGMAS_S[:, None] ** 2)
# Standard deviations in seconds that are added to the estimated ones of the times. They stand for
# errors that more views do not reduce, because blur and occlusion displace edges. They are about
# the errors on the simulated camera of `room-handheld` and `tour-handheld` with 30 views.
TIME_FLOOR_S = (0.0015, 0.004, 0.001)
# Maximum held-out residual, relative to that without correction, at which a depth bias or
# vignetting that was confirmed before stays in use. It was 0.90 to 0.93 on bonn_crowd, where people
# walk through the views, and 1.00 where there is no bias.
MAX_KEPT_RATIO = 0.97
# Gauss-Newton steps of the first estimate, and of later ones, which start from its result.
FIRST_ROUNDS, LATER_ROUNDS = 3, 2
COLOR_ROUNDS = 2
VIEW_GROUPS = 5  # Groups of views for the jackknife.
GRAY_SIGMA = 1.0  # Minimum noise of a blurred color, gray levels.
# Work of the steps below; a unit is about 1 ms on one core of an AMD EPYC.
SURFACE_WORK, PAIR_WORK, COLOR_PAIR_WORK, COLOR_ROUND_WORK = 0.3, 0.5, 0.3, 0.3


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated depth bias, shutter times and vignetting, and relative poses of the views."""

    depth_bias: np.ndarray  # [3] 1/m, see `CameraCorrection`.
    depth_bias_covariance: np.ndarray  # [3, 3] 1/m^2
    times_s: np.ndarray  # [3], times of the shutter in the order of `ShutterTiming`.
    times_covariance: np.ndarray  # [3, 3] s^2
    vignetting: np.ndarray  # [3, 3] color channel by term, see `CameraCorrection`.
    pairs: list[ViewPair]  # Pairs with their relative poses, estimated jointly with the bias.
    depth_check: HeldOutResiduals  # Residuals of the dense depth alone, without features.
    color_checks: list[HeldOutResiduals]  # One per channel; empty if too few colors were compared.
    # Error of the pose between depth and color; None if it was not requested, or if the outlines of
    # surfaces do not determine it.
    extrinsics: Extrinsics | None

    @property
    def is_finite(self) -> bool:
        """True if all coefficients are finite; degenerate pairs of views may make them NaN."""
        values = self.depth_bias, self.times_s, self.vignetting
        return all(np.isfinite(value).all() for value in values)

    @property
    def depth_ratio(self) -> float:
        """Held-out depth residual with the bias removed, divided by the residual of raw depth."""
        return self.depth_check.residual_ratio

    @property
    def color_ratio(self) -> float:
        """Held-out color residual with vignetting removed, divided by the residual of raw color."""
        without = sum(check.rms_without for check in self.color_checks)
        return sum(check.rms_with for check in self.color_checks) / without if without else 1.0

    def confirmed(
        self, before: CameraCorrection, max_ratios: tuple[float, float], *, is_known: bool
    ) -> CameraCorrection:
        """Return the correction to use after this estimate.

        Depth bias and vignetting are decided separately. Each has a residual ratio: the residual of
        held-out pairs of views with the new estimate, divided by the residual without correction.

        - If the ratio is at most its limit in `max_ratios`, the new estimate is used.
        - If the ratio is larger, but at most `MAX_KEPT_RATIO`, a camera that `before` corrects
          stays corrected. The correction comes from `before` if `is_known` is True, else from the
          new estimate.
        - In all other cases, the coefficients are 0: the camera is not corrected.

        Args:
            before: Correction that is in use before this estimate.
            max_ratios: Maximum residual ratios of the depth bias and of the vignetting.
            is_known: True if `before` comes from an earlier run.
        """
        depth_bias, vignetting = CameraCorrection().depth_bias, CameraCorrection().vignetting
        new_bias = tuple(self.depth_bias.tolist())
        new_vignetting = tuple(map(tuple, self.vignetting.tolist()))
        if self.depth_ratio <= max_ratios[0]:
            depth_bias = new_bias
        elif before.has_depth_bias and self.depth_ratio <= MAX_KEPT_RATIO:
            depth_bias = before.depth_bias if is_known else new_bias
        if self.color_ratio <= max_ratios[1]:
            vignetting = new_vignetting
        elif before.has_vignetting and self.color_ratio <= MAX_KEPT_RATIO:
            vignetting = before.vignetting if is_known else new_vignetting
        return CameraCorrection(depth_bias, vignetting)


def estimate(
    views: Mapping[int, CalibrationView],
    pairs: Sequence[ViewPair],
    depth_bias: np.ndarray,
    times_s: np.ndarray,
    vignetting: np.ndarray,
    *,
    finds_extrinsics: bool = False,
) -> Generator[float, None, Estimate]:
    """Estimate depth bias, shutter times, relative poses and vignetting by Gauss-Newton steps.

    The generator yields after each small step, such as the comparison of one pair, so that the
    caller can spread the work over frames. The yielded value is the work of the step; one unit
    takes about 1 ms.

    Args:
        views: Views by their numbers.
        pairs: Pairs of these views, in the order of time.
        depth_bias: Initial coefficients of the depth bias, [3] 1/m.
        times_s: Initial shutter times, [3] seconds, in the order of `ShutterTiming`.
        vignetting: Initial coefficients of the vignetting, [3, 3]: color channel by term.
        finds_extrinsics: True to estimate the error of the pose between depth and color too.
    """
    shared = np.concatenate([depth_bias, times_s])
    linear = yield from _linearized(views, pairs, shared)
    for _ in range((LATER_ROUNDS if shared.any() else FIRST_ROUNDS) - 1):
        step = solve(linear.reduced, SHARED_PRIOR, shared)
        shared, pairs = shared + step, _moved(pairs, linear, step)
        linear = yield from _linearized(views, pairs, shared)
    before, step = shared, solve(linear.reduced, SHARED_PRIOR, shared)
    shared, pairs = shared + step, _moved(pairs, linear, step)
    uncertainty = covariance(linear.reduced, SHARED_PRIOR, before, _pairs_of_views(pairs))
    dense = [Reduced.of(block.products, BIAS_TERMS) for block in linear.dense]
    (depth_check,) = yield from check(linear.dense, dense, DEPTH_PRIOR, before[BIAS])
    colors, color_checks = yield from _vignetting(views, pairs, linear.common, vignetting)
    pose = None
    if finds_extrinsics:
        shown = [views[number] for number in sorted(views)]
        velocities = [view.velocity for view in shown]
        pose = yield from extrinsics([v.outlines for v in shown], velocities, shared[TIMES])
    return Estimate(
        shared[BIAS],
        uncertainty[BIAS, BIAS],
        shared[TIMES],
        uncertainty[TIMES, TIMES] + np.diag(np.square(TIME_FLOOR_S)),
        colors,
        pairs,
        depth_check,
        color_checks,
        pose,
    )


def _pairs_of_views(pairs: Sequence[ViewPair]) -> list[set[int]]:
    """Group the indices of all pairs by successive views.

    A group has all pairs that use at least one of its views, so a pair may be in two groups. Pairs
    that share a view share its errors. The jackknife therefore leaves out whole views.
    """
    numbers = sorted({number for p in pairs for number in (p.first, p.second)})
    groups = np.array_split(numbers, min(VIEW_GROUPS, len(numbers)))
    return [
        {i for i, p in enumerate(pairs) if p.first in group or p.second in group}
        for group in map(set, groups)
    ]


# --- depth ----------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class _Linearized:
    """Equations of all pairs, linearized at given coefficients and poses."""

    reduced: list[Reduced]  # Dense depth and features.
    dense: list[Block]  # Dense depth with the times as constants.
    common: list[CommonPoints]


def _linearized(
    views: Mapping[int, CalibrationView], pairs: Sequence[ViewPair], shared: np.ndarray
) -> Generator[float, None, _Linearized]:
    surfaces: dict[int, np.ndarray] = {}
    linear = _Linearized([], [], [])
    for p in pairs:
        for number in (p.first, p.second):
            if number not in surfaces:
                surfaces[number] = view_surface(views[number], shared[BIAS])
                yield SURFACE_WORK
        compared = ComparedPair(views[p.first], views[p.second], p, shared)
        block, points = depth_block(compared, surfaces[p.first], surfaces[p.second])
        features = feature_block(compared, surfaces[p.first])
        products = block.products + features.products
        linear.reduced.append(Reduced.of(products, len(shared)))
        at_times = np.delete(block.rows, np.r_[TIMES], axis=1)
        linear.dense.append(replace(block, rows=at_times))
        linear.common.append(points)
        yield PAIR_WORK
    return linear


def _moved(pairs: Sequence[ViewPair], linear: _Linearized, step: np.ndarray) -> list[ViewPair]:
    """Return the pairs with the relative poses after a step [3] of the coefficients."""
    return [
        p.at(se3.exp(reduced.own_step(step)) @ p.T_second_first)
        for p, reduced in zip(pairs, linear.reduced, strict=True)
    ]


# --- color ----------------------------------------------------------------------------------------
def _vignetting(
    views: Mapping[int, CalibrationView],
    pairs: Sequence[ViewPair],
    common: Sequence[CommonPoints],
    start: np.ndarray,
) -> Generator[float, None, tuple[np.ndarray, list[HeldOutResiduals]]]:
    """Estimate the coefficients of the vignetting, [3, 3], and check each channel."""
    compared: list[Block] = []
    for p, points in zip(pairs, common, strict=True):
        block = color_block(views[p.first], views[p.second], points)
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
    """Compute the weights [3, N] of the rows [3, N, 6] of a pair from their residuals.

    Args:
        rows: Derivatives with respect to vignetting, gain and offset, and the residual without
            vignetting.
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
