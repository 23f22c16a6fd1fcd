"""Estimation of the timing of a shutter while tracking, from frames with a known timing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ldo_service.calibration.knowledge import CameraKnowledge
from ldo_service.calibration.shutter import FrameMotion, ShutterTiming
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import Odometry, OdometryConfig
from ldo_service.tracking.alignment import align
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.motion import image_motion_rad
from ldo_service.tracking.pyramid import Pyramid, build_reference, pyramid_of
from ldo_service.tracking.shutter import ShutterConfig, ShutterState
from ldo_service.tracking.shutter_timing import MIN_GROUPS, TimingEvidence, band_equations
from tests.moving_camera import MovingCamera

TIMING = ShutterTiming(0.024, 0.012, 0.010)
RATE_HZ, COUNT = 30, 70
CONFIG = OdometryConfig()
SHUTTER = ShutterConfig()
OFF = replace(CONFIG, shutter=ShutterConfig(is_on=False))


@pytest.fixture(scope="module")
def camera() -> MovingCamera:
    return MovingCamera()


@pytest.fixture(scope="module")
def frames(camera: MovingCamera) -> list[RgbdFrame]:
    return [camera.frame(index / RATE_HZ, TIMING, index) for index in range(COUNT)]


def tracked(frames: list[RgbdFrame], config: OdometryConfig) -> tuple[Odometry, list[str]]:
    odometry = Odometry(config)
    return odometry, [str(odometry.process(frame).status) for frame in frames]


def timing_of(odometry: Odometry) -> ShutterTiming:
    return ShutterTiming.of(odometry.snapshot()["shutter"]["timing"])


def test_estimated_timing_is_that_of_the_camera_and_keeps_the_track(
    frames: list[RgbdFrame],
) -> None:
    odometry, statuses = tracked(frames, CONFIG)
    found = timing_of(odometry)
    assert found.readout_s == pytest.approx(TIMING.readout_s, abs=0.002)
    assert found.depth_readout_s == pytest.approx(TIMING.depth_readout_s, abs=0.004)
    assert found.depth_delay_s == pytest.approx(TIMING.depth_delay_s, abs=0.002)
    assert statuses == ["OK"] * COUNT
    assert "LOST" in tracked(frames, OFF)[1]  # The frames are hard without compensation.


def test_known_timing_is_used_from_the_first_motion_on(
    camera: MovingCamera, frames: list[RgbdFrame]
) -> None:
    known = replace(CONFIG, shutter=ShutterConfig(initial=TIMING))
    odometry = Odometry(known)
    # Later frames have enough evidence for an estimate.
    motions = [odometry.process(frame).motion for frame in frames[:14]]
    assert motions[0] is None
    errors = []
    for index in range(4, 14):
        used = motions[index]
        assert used is not None
        assert used.timing == TIMING
        # The mean velocity since the frame before, half a frame earlier.
        expected = camera.velocity((index - 0.5) / RATE_HZ)[:3]
        errors.append(np.linalg.norm(used.velocity[:3] - expected) / np.linalg.norm(expected))
    assert np.median(errors) < 0.07


def test_corrected_pose_is_closer_to_that_of_a_frame_aligned_again(
    camera: MovingCamera, frames: list[RgbdFrame]
) -> None:
    """The frames are compensated with three quarters of their velocity, and with all of it."""
    config, still = CONFIG.pyramid, FrameMotion(np.zeros(6), TIMING)
    errors = []
    for index in range(3, 20, 4):
        T_reference, T_true = camera.pose((index - 2) / RATE_HZ), camera.pose(index / RATE_HZ)
        at_once = camera.frame((index - 2) / RATE_HZ, ShutterTiming())
        reference = build_reference(pyramid_of(at_once, config))
        right = FrameMotion(camera.velocity(index / RATE_HZ), TIMING)
        wrong = FrameMotion(0.75 * right.velocity, TIMING)
        views = [pyramid_of(frames[index], config, motion) for motion in (wrong, right)]
        guess = se3.inverse(T_true) @ T_reference
        before, after = (align(reference, view, guess, CONFIG.align) for view in views)
        equations = band_equations(
            reference,
            views[0],
            se3.inverse(before.T_reference_camera),
            before.appearance,
            CONFIG.align.residuals,
            still,
            wrong,
            still.velocity,
        )
        assert not equations.pose_change(wrong.velocity).any()
        change = se3.exp(equations.pose_change(right.velocity))
        poses = before.T_reference_camera, before.T_reference_camera @ change
        errors.append([difference_rad(T, after.T_reference_camera) for T in poses])
    uncorrected, corrected = np.median(errors, axis=0)
    assert corrected < 0.8 * uncorrected


def difference_rad(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return image_motion_rad(se3.inverse(T_a) @ T_b, 2.0)


@pytest.mark.parametrize("max_linear_ratio", [0.0, 1.0])
def test_pose_is_as_exact_with_and_without_a_second_alignment(
    camera: MovingCamera, frames: list[RgbdFrame], max_linear_ratio: float
) -> None:
    shutter = ShutterConfig(initial=TIMING, max_linear_ratio=max_linear_ratio)
    odometry = Odometry(replace(CONFIG, shutter=shutter))
    T_first = camera.pose(0.0)
    for i, frame in enumerate(frames):
        result = odometry.process(frame)
        T_true = se3.inverse(T_first) @ camera.pose(i / RATE_HZ)
        assert se3.distances(se3.inverse(T_true) @ result.T_odom_camera) < 0.014


@pytest.mark.slow
def test_camera_that_records_at_once_is_not_compensated(camera: MovingCamera) -> None:
    at_once = [camera.frame(i / RATE_HZ, ShutterTiming(), i) for i in range(COUNT)]
    odometry, poses = tracked(at_once, CONFIG)
    assert not timing_of(odometry)
    off = replace(CONFIG, shutter=ShutterConfig(is_on=False))
    assert np.array_equal(poses, tracked(at_once, off)[1])


def test_restored_odometry_continues_bit_for_bit(frames: list[RgbdFrame]) -> None:
    odometry = Odometry(CONFIG)
    for frame in frames[:30]:
        odometry.process(frame)
    assert timing_of(odometry)
    saved = decode_state(encode_state(odometry.snapshot()))
    restored = Odometry(CONFIG)
    restored.restore(saved)
    for frame in frames[30:45]:
        a, b = odometry.process(frame), restored.process(frame)
        assert np.array_equal(a.T_odom_camera, b.T_odom_camera)
        assert a.motion is not None
        assert b.motion is not None
        assert np.array_equal(a.motion.velocity, b.motion.velocity)
    assert encode_state(odometry.snapshot()["shutter"]) == encode_state(
        restored.snapshot()["shutter"]
    )


def test_frames_at_2_hz_have_no_known_motion(camera: MovingCamera) -> None:
    odometry = Odometry(CONFIG)
    slow = [replace(camera.frame(i / RATE_HZ, TIMING, i), stamp_ns=i * 500_000_000) for i in (0, 1)]
    assert [odometry.process(frame).motion for frame in slow] == [None, None]


def test_estimate_of_the_calibration_is_used_at_once_and_refined(
    camera: MovingCamera, frames: list[RgbdFrame]
) -> None:
    near = ShutterTiming(0.027, 0.017, 0.007)
    information = np.diag([0.002**-2, 0.004**-2, 0.002**-2])
    known = CameraKnowledge(timing=np.c_[information, information @ near.times_s])
    odometry, T_first = Odometry(CONFIG), camera.pose(0.0)
    for i, frame in enumerate(frames[:40]):
        result = odometry.process(frame, camera=known if i >= 4 else None)
        if i == 4:
            assert timing_of(odometry).times_s == pytest.approx(near.times_s)
        T_true = se3.inverse(T_first) @ camera.pose(i / RATE_HZ)
        assert se3.distances(se3.inverse(T_true) @ result.T_odom_camera) < 0.03
    assert np.abs(np.subtract(timing_of(odometry).times_s, TIMING.times_s)).max() < 0.003


def test_uncertain_estimate_of_the_calibration_is_not_used() -> None:
    information = np.diag([0.01**-2] * 3)
    state = ShutterState().informed(np.c_[information, information @ [0.02, 0.02, 0.0]], SHUTTER)
    assert not state.timing
    assert state.evidence.estimate() is not None


def test_reference_follows_a_new_timing(camera: MovingCamera) -> None:
    time_s = 1.6  # The camera turns by 68 degrees/s.
    images = [camera.frame(time_s, timing) for timing in (TIMING, ShutterTiming())]
    recorded, at_once = (pyramid_of(image, CONFIG.pyramid) for image in images)
    keyframe = ReferenceKeyframe(recorded, np.eye(4), 0)
    retimed = keyframe.retimed(TIMING, camera.velocity(time_s), CONFIG.pyramid)
    assert retimed.motion is not None
    assert retimed.motion.timing == TIMING

    def error(a: Pyramid) -> float:
        is_shown = (a.gray > 0) & (at_once.gray > 0)
        return float(np.mean(np.abs(a.gray.astype(float) - at_once.gray)[is_shown]))

    assert error(retimed.view) < 0.4 * error(recorded)
    again = retimed.retimed(ShutterTiming(), np.zeros(6), CONFIG.pyramid)
    assert error(again.view) > 0.8 * error(recorded)


def test_evidence_keeps_its_sum_when_groups_are_merged() -> None:
    rng = np.random.default_rng(0)
    measurements = rng.random((100, 3, 4))
    evidence = TimingEvidence()
    for measurement in measurements:
        evidence = evidence.extended(measurement)
    assert evidence.count == 100
    assert MIN_GROUPS <= len(evidence.groups) <= 24
    assert np.allclose(np.sum(evidence.groups, axis=0), measurements.sum(axis=0))


def test_metrics_have_the_estimate_with_its_standard_deviation() -> None:
    times_s = np.array([0.02, 0.01, -0.005])
    state = ShutterState(timing=ShutterTiming(0.019, 0.009, -0.004))
    measurement = np.c_[1e9 * np.eye(3), 1e9 * times_s]
    without = {"readout_ms": 19.0, "depth_readout_ms": 9.0, "depth_delay_ms": -4.0}
    assert state.metrics() == pytest.approx(without)
    for _ in range(MIN_GROUPS):
        state = replace(state, evidence=state.evidence.extended(measurement))
    estimate = state.evidence.estimate()
    assert estimate is not None
    found = state.metrics()
    for k, name in enumerate(("readout", "depth_readout", "depth_delay")):
        assert found[f"{name}_ms"] == pytest.approx(without[f"{name}_ms"])
        assert found[f"{name}_estimate_ms"] == pytest.approx(1e3 * times_s[k], rel=1e-3)
        assert found[f"{name}_sigma_ms"] == 1e3 * estimate[1][k] > 0


def test_evidence_that_contradicts_itself_is_uncertain() -> None:
    evidence = TimingEvidence()
    for sign in (1, -1) * 20:
        evidence = evidence.extended(np.c_[1e6 * np.eye(3), sign * 1e6 * 0.02 * np.ones(3)])
    found = evidence.estimate()
    assert found is not None
    times_s, sigmas_s = found
    assert (np.abs(times_s) < 4 * sigmas_s).all()


@pytest.mark.parametrize("interval_ns", [5_000_000, 1])
def test_wrong_stamp_does_not_move_the_image(
    camera: MovingCamera, frames: list[RgbdFrame], interval_ns: int
) -> None:
    """Frame 12 has a stamp too close to that of frame 11."""
    odometry = Odometry(replace(CONFIG, shutter=ShutterConfig(initial=TIMING)))
    some = list(frames[:16])
    some[12] = replace(some[12], stamp_ns=some[11].stamp_ns + interval_ns)
    results = [odometry.process(frame) for frame in some]
    assert results[12].motion is None
    T_first = camera.pose(0.0)
    for i, result in enumerate(results):
        T_true = se3.inverse(T_first) @ camera.pose(i / RATE_HZ)
        assert se3.distances(se3.inverse(T_true) @ result.T_odom_camera) < 0.02


def test_slow_motion_does_not_use_up_the_evidence(camera: MovingCamera) -> None:
    odometry = Odometry(CONFIG)
    for i in range(12):  # A sixteenth of the speed.
        time_s = i / RATE_HZ / 16
        frame = camera.frame(time_s, TIMING, i)
        odometry.process(replace(frame, stamp_ns=round(1e9 * i / RATE_HZ)))
    assert odometry.snapshot()["shutter"]["evidence"]["count"] == 0


@pytest.mark.parametrize("interval_s", [0.005, 0.02])
def test_implausible_motion_is_unknown(interval_s: float) -> None:
    far = se3.exp(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    assert FrameMotion.between(np.eye(4), far, interval_s, TIMING) is None
    near = FrameMotion.between(np.eye(4), far, 0.1, TIMING)
    assert near is not None
    assert near.velocity == pytest.approx([0.0, 5.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("name", ["sigmas", "max_s", "max_interval_s", "update_frames"])
def test_config_rejects_zero(name: str) -> None:
    values: dict[str, Any] = {name: 0}
    with pytest.raises(ConfigError, match=name):
        ShutterConfig(**values)
