"""Compensation of rolling shutter and late depth, compared with exact renderings."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.calibration.shutter import FrameMotion, ShutterTiming, displacement_rad
from ldo_service.geometry import RgbdFrame, se3
from tests.moving_camera import MovingCamera

TIMING = ShutterTiming(0.030, 0.020, -0.012)
AT_S = 1.6  # The camera turns by 68 degrees/s and moves by 0.45 m/s.


@pytest.fixture(scope="module")
def camera() -> MovingCamera:
    return MovingCamera()


def color_error(a: RgbdFrame, b: RgbdFrame) -> float:
    """Return the mean difference of two images in gray levels, where both show the scene."""
    both = (a.color.max(axis=2) > 0) & (b.color.max(axis=2) > 0)
    return float(np.mean(np.abs(a.color.astype(float) - b.color)[both]))


def depth_error_m(a: RgbdFrame, b: RgbdFrame) -> float:
    both = (a.depth_m > 0) & (b.depth_m > 0)
    return float(np.median(np.abs(a.depth_m - b.depth_m)[both]))


def test_compensated_frame_is_close_to_a_frame_recorded_at_once(camera: MovingCamera) -> None:
    recorded, at_once = camera.frame(AT_S, TIMING), camera.frame(AT_S, ShutterTiming())
    motion = FrameMotion(camera.velocity(AT_S), TIMING)
    compensated = motion.compensated(recorded)
    assert displacement_rad(motion.velocity, TIMING, 2.0) > 0.02  # More than 5 of 320 pixels.
    assert color_error(compensated, at_once) < 0.35 * color_error(recorded, at_once)
    assert depth_error_m(compensated, at_once) < 0.2 * depth_error_m(recorded, at_once)


@pytest.mark.parametrize("wrong", ["readout_s", "depth_readout_s", "depth_delay_s"])
def test_opposite_time_makes_the_frame_worse(camera: MovingCamera, wrong: str) -> None:
    recorded, at_once = camera.frame(AT_S, TIMING), camera.frame(AT_S, ShutterTiming())
    timing = replace(ShutterTiming(), **{wrong: -getattr(TIMING, wrong)})
    compensated = FrameMotion(camera.velocity(AT_S), timing).compensated(recorded)
    error = color_error if wrong == "readout_s" else depth_error_m
    assert error(compensated, at_once) > 1.05 * error(recorded, at_once)


def test_rendering_is_distorted_as_the_camera_records_it(camera: MovingCamera) -> None:
    recorded, at_once = camera.frame(AT_S, TIMING), camera.frame(AT_S, ShutterTiming())
    motion = FrameMotion(camera.velocity(AT_S), TIMING)
    shown = motion.recorded(
        at_once.color.astype(np.float32), at_once.depth_m, at_once.camera
    ).astype(np.uint8)
    distorted = replace(at_once, color=shown)
    assert color_error(distorted, recorded) < 0.35 * color_error(at_once, recorded)


def test_frame_without_motion_or_timing_is_returned_unchanged(camera: MovingCamera) -> None:
    frame = camera.frame(AT_S, TIMING)
    assert FrameMotion(camera.velocity(AT_S), ShutterTiming()).compensated(frame) is frame
    assert FrameMotion(np.zeros(6), TIMING).compensated(frame) is frame


def test_unknown_depth_stays_unknown(camera: MovingCamera) -> None:
    frame = camera.frame(AT_S, TIMING)
    blind = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    compensated = FrameMotion(camera.velocity(AT_S), TIMING).compensated(blind)
    assert not compensated.depth_m.any()
    assert np.isfinite(compensated.depth_m).all()


def test_packed_timing_and_motion_are_restored() -> None:
    motion = FrameMotion(np.arange(6.0), TIMING)
    restored = FrameMotion.unpack(motion.pack())
    assert restored.timing == TIMING
    assert np.array_equal(restored.velocity, motion.velocity)
    assert ShutterTiming.of({}) == ShutterTiming()


def test_camera_moves_as_fast_as_the_tests_say(camera: MovingCamera) -> None:
    velocity = camera.velocity(AT_S)
    assert np.linalg.norm(velocity[:3]) > np.radians(60)
    T = camera.pose(AT_S)
    moved = T @ se3.exp(velocity * 0.01)
    assert np.allclose(moved, camera.pose(AT_S + 0.01), atol=3e-3)
