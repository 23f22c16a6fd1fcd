"""Joint estimate of depth bias and shutter timing, on frames of a known rolling shutter."""

from collections.abc import Generator
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.optimize import least_squares

from ldo_service.calibration.comparison import (
    ComparedPair,
    depth_block,
    feature_block,
    view_surface,
)
from ldo_service.calibration.correction import unbiased_depth
from ldo_service.calibration.elimination import Reduced, solve
from ldo_service.calibration.estimation import SHARED_PRIOR, Estimate, estimate
from ldo_service.calibration.self_calibration import SelfCalibration
from ldo_service.calibration.shutter import FrameMotion, ShutterTiming
from ldo_service.calibration.views import CalibrationView, ViewMaker, ViewPair, pair_of
from ldo_service.geometry import RgbdFrame, se3
from tests.moving_camera import MovingCamera

TIMING = ShutterTiming(0.024, 0.012, 0.010)
BIAS = np.array([-0.017, -0.012, 0.008])  # 1/m, in inverse depth.
RATE_HZ, COUNT = 30, 12


@pytest.fixture(scope="module")
def camera() -> MovingCamera:
    return MovingCamera()


def recorded(camera: MovingCamera, index: int, timing: ShutterTiming) -> RgbdFrame:
    """Return a frame of a rolling shutter, whose depth has a bias."""
    frame = camera.frame(index / RATE_HZ, timing, index)
    v, u = np.mgrid[: frame.camera.height, : frame.camera.width]
    x, y = (u / (frame.camera.width - 1) - 0.5) * 2, (v - (frame.camera.height - 1) / 2)
    y = y * 2 / frame.camera.width
    bias = BIAS[0] * x * x + BIAS[1] * x * y + BIAS[2] * y * y
    return replace(frame, depth_m=unbiased_depth(frame.depth_m, -bias))


@lru_cache(maxsize=2)  # Rendering the frames takes longer than the tests.
def views_of(
    camera: MovingCamera, timing: ShutterTiming
) -> tuple[dict[int, CalibrationView], list[ViewPair]]:
    maker, views, pairs = ViewMaker(), {}, []
    for n in range(COUNT):
        index = 36 + 2 * n
        time_s = index / RATE_HZ
        raw = recorded(camera, index, timing)
        views[n] = maker.make(raw, camera.pose(time_s), camera.velocity(time_s))
        pairs += [pair_of(views[n - d], views[n]) for d in (1, 2, 3) if n >= d]
    return views, sorted((p for p in pairs if p is not None), key=lambda p: (p.first, p.second))


def finished(steps: Generator[float, None, Estimate]) -> Estimate:
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


@pytest.mark.parametrize("timing", [TIMING, ShutterTiming()], ids=["rolling", "at once"])
def test_bias_and_times_are_found_together(camera: MovingCamera, timing: ShutterTiming) -> None:
    views, pairs = views_of(camera, timing)
    start = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    found = finished(estimate(views, pairs, *start))
    found = finished(estimate(views, found.pairs, found.depth_bias, found.times_s, start[2]))
    assert np.abs(found.times_s - timing.times_s).max() < 0.003
    assert np.abs(found.depth_bias - BIAS).max() < 0.004
    sigmas = np.sqrt(np.diag(found.depth_bias_covariance))
    assert (np.abs(found.depth_bias - BIAS) < 4 * sigmas).all()


def test_bias_is_worse_if_the_motion_of_the_views_is_unknown(camera: MovingCamera) -> None:
    views, pairs = views_of(camera, TIMING)
    still = {n: replace(view, velocity=np.zeros(6)) for n, view in views.items()}
    start = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    errors = [
        np.linalg.norm(finished(estimate(each, pairs, *start)).depth_bias - BIAS)
        for each in (views, still)
    ]
    assert errors[0] < 0.6 * errors[1]


def test_step_of_the_joint_equations_equals_that_of_scipy(camera: MovingCamera) -> None:
    views, pairs = views_of(camera, TIMING)
    pairs, shared = pairs[:3], np.zeros(6)
    blocks = []
    for pair in pairs:
        first, second = views[pair.first], views[pair.second]
        compared = ComparedPair(first, second, pair, shared)
        surfaces = [view_surface(view, shared[:3]) for view in (first, second)]
        blocks.append((depth_block(compared, *surfaces)[0], feature_block(compared, surfaces[0])))
    reduced = [Reduced.of(a.products + b.products, 6) for a, b in blocks]
    step = solve(reduced, SHARED_PRIOR, shared)
    root = np.linalg.cholesky(SHARED_PRIOR).T

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        common, own = unknowns[:6], unknowns[6:].reshape(-1, 6)
        parts = [root @ common]
        for pose, both in zip(own, blocks, strict=True):
            change = np.concatenate([common, pose, [1.0]])
            parts += [np.sqrt(block.weight) * (block.rows @ change) for block in both]
        return np.concatenate(parts)

    expected = least_squares(residuals, np.zeros(6 + 6 * len(pairs)), x_scale="jac").x
    np.testing.assert_allclose(step, expected[:6], atol=1e-6)
    own = np.concatenate([r.own_step(step) for r in reduced])
    np.testing.assert_allclose(own, expected[6:], atol=1e-6)


def test_derivatives_of_features_equal_finite_differences(camera: MovingCamera) -> None:
    views, pairs = views_of(camera, TIMING)
    pair = pairs[1]
    first, second = views[pair.first], views[pair.second]
    shared = np.array([*BIAS, *TIMING.times_s])
    surface = view_surface(first, shared[:3])
    rows = feature_block(ComparedPair(first, second, pair, shared), surface).rows
    for axis in range(12):
        step = np.zeros(12)
        step[axis] = 1e-6
        moved = pair.at(se3.exp(step[6:]) @ pair.T_second_first)
        changed = feature_block(ComparedPair(first, second, moved, shared + step[:6]), surface)
        change = (changed.rows[:, -1] - rows[:, -1]) / 1e-6
        # Second-order terms of the motion during the frame are left out.
        largest = np.abs(rows[:, axis]).max()
        np.testing.assert_allclose(change, rows[:, axis], atol=0.05 * largest)


def test_timing_is_known_after_few_frames(camera: MovingCamera) -> None:
    calibration, before = SelfCalibration(), None
    for index in range(36, 58):
        pose = camera.pose(index / RATE_HZ)
        motion = None
        if before is not None:
            motion = FrameMotion.between(before, pose, 1 / RATE_HZ, ShutterTiming())
        calibration.observe(recorded(camera, index, TIMING), pose, motion)
        before = pose
    timing = calibration.knowledge.timing
    assert timing is not None
    times_s = np.linalg.solve(timing[:, :3], timing[:, 3])
    sigmas_s = np.sqrt(np.diag(np.linalg.inv(timing[:, :3])))
    assert np.abs(times_s - TIMING.times_s).max() < 0.006
    assert (np.abs(times_s - TIMING.times_s) < 4 * sigmas_s).all()
