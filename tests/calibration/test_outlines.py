"""Pose between depth and color camera, on frames with a known error of this pose."""

from collections.abc import Generator
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest

from ldo_service.calibration.outlines import Extrinsics, extrinsics, outline_points
from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.geometry import RgbdFrame, se3
from tests.moving_camera import MovingCamera

T = TypeVar("T")
COUNT = 12
ALIGNED = np.zeros(6)
DISPLACED = np.array([0.01, -0.015, 0.006, 0.015, 0.01, -0.01])  # rad, m


@pytest.fixture(scope="module")
def camera() -> MovingCamera:
    return MovingCamera()


def returned(steps: Generator[object, None, T]) -> T:
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


def displaced(camera: MovingCamera, time_s: float, xi: np.ndarray) -> RgbdFrame:
    """Return a frame whose depth camera is at exp(xi), although depth counts as registered."""
    frame = camera.frame(time_s, ShutterTiming())
    T_world_depth = camera.pose(time_s) @ se3.exp(xi)
    return replace(frame, depth_m=camera.depth_m(T_world_depth))


def found_extrinsics(camera: MovingCamera, xi: np.ndarray) -> Extrinsics:
    frames = [displaced(camera, 0.2 + 0.3 * n, xi) for n in range(COUNT)]
    points = [outline_points(frame.color, frame.depth_m, frame.camera) for frame in frames]
    found = returned(extrinsics(points, [np.zeros(6)] * COUNT, np.zeros(3)))
    assert found is not None
    return found


@pytest.mark.parametrize("xi", [ALIGNED, DISPLACED], ids=["aligned", "displaced"])
def test_pose_between_depth_and_color_is_found_within_its_sigma(
    camera: MovingCamera, xi: np.ndarray
) -> None:
    found = found_extrinsics(camera, xi)
    sigmas = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.xi - xi) < 3 * sigmas).all()
    assert sigmas[:3].max() < np.deg2rad(0.5)
    assert sigmas[3:].max() < 0.02


def test_shift_of_displaced_depth_is_significant(camera: MovingCamera) -> None:
    found = found_extrinsics(camera, DISPLACED)
    metrics = found.metrics()
    shift, sigma = (metrics[f"depth_color_shift_u_{kind}mrad"] for kind in ("", "sigma_"))
    assert abs(shift) > 3 * sigma
    expected = 1e3 * (DISPLACED[1] + DISPLACED[3] / 2)
    assert abs(shift - expected) < 3 * sigma


def test_motion_between_color_and_depth_is_no_displacement(camera: MovingCamera) -> None:
    timing = ShutterTiming(depth_delay_s=0.02)
    times_s = [0.2 + 0.3 * n for n in range(COUNT)]
    frames = [camera.frame(time_s, timing) for time_s in times_s]
    points = [outline_points(frame.color, frame.depth_m, frame.camera) for frame in frames]
    velocities = [camera.velocity(time_s) for time_s in times_s]
    found = returned(extrinsics(points, velocities, np.array(timing.times_s)))
    assert found is not None
    assert (np.abs(found.xi) < 3 * np.sqrt(np.diag(found.covariance))).all()


def test_wrong_delay_of_depth_is_no_displacement(camera: MovingCamera) -> None:
    times_s = [0.2 + 0.3 * n for n in range(COUNT)]
    frames = [camera.frame(time_s, ShutterTiming(depth_delay_s=0.02)) for time_s in times_s]
    points = [outline_points(frame.color, frame.depth_m, frame.camera) for frame in frames]
    velocities = [camera.velocity(time_s) for time_s in times_s]
    found = returned(extrinsics(points, velocities, np.zeros(3)))
    assert found is not None
    assert (np.abs(found.xi) < 3 * np.sqrt(np.diag(found.covariance))).all()


def test_frames_without_outlines_yield_no_pose() -> None:
    assert returned(extrinsics([], [], np.zeros(3))) is None
