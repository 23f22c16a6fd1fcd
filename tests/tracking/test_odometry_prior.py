"""Odometry priors: a correct prior helps tracking, and a wrong one changes nothing."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import (
    Odometry,
    OdometryConfig,
    OdometryPriorBuffer,
    PriorConfig,
    TrackingResult,
    TrackingStatus,
)
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.odometry_prior import KEPT, DeadReckoningStart, PriorCheck, PriorPose
from ldo_service.tracking.relocalization import RelocalizationConfig
from ldo_service.tracking.submaps import SubmapConfig

CONFIG = PriorConfig()
PERIOD_NS = 33_333_333
MS = 1_000_000
FORWARD = np.array([0.0, 0.1, 0.0, 0.2, 0.0, 0.5])  # A turn and a step.
IDENTITY = np.eye(4)


def prior_of(stamps_ns: list[int], poses: list[np.ndarray]) -> OdometryPriorBuffer:
    prior = OdometryPriorBuffer()
    for stamp_ns, T in zip(stamps_ns, poses, strict=True):
        prior, check = prior.added(stamp_ns, T, CONFIG)
        assert check is PriorCheck.FOLLOWS
    return prior


def at(prior: OdometryPriorBuffer, stamp_ns: int) -> np.ndarray | None:
    reading = prior.at(stamp_ns, IDENTITY, CONFIG)
    return None if reading is None else reading.T_prior_camera


# --- a pose at any stamp --------------------------------------------------------------------------
def test_interpolated_pose_equals_slerp_and_linear_translation() -> None:
    a, b = se3.exp(np.array([0.2, -0.4, 0.1, 1.0, 0.0, 2.0])), se3.exp(FORWARD)
    prior = prior_of([0, 200 * MS], [a, b])
    slerp = Slerp([0, 200], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))
    for ms in (0, 1, 70, 199, 200):
        T = at(prior, ms * MS)
        assert T is not None
        np.testing.assert_allclose(T[:3, :3], slerp(ms).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(T[:3, 3], a[:3, 3] + ms / 200 * (b - a)[:3, 3], atol=1e-12)


def test_extrapolation_has_constant_velocity_up_to_the_limit() -> None:
    stamps_ns = [k * 20 * MS for k in range(10)]
    twist = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
    prior = prior_of(stamps_ns, [se3.exp(k * twist) for k in range(10)])
    T = at(prior, 180 * MS + 40 * MS)
    assert T is not None
    np.testing.assert_allclose(T, se3.exp(11 * twist), atol=1e-12)
    assert at(prior, 180 * MS + 51 * MS) is None
    assert at(prior_of([0], [IDENTITY]), 10 * MS) is None, "one pose has no velocity"


def test_extrapolation_does_not_amplify_noise_of_close_poses() -> None:
    """One millimeter of noise on the newest pose at 200 Hz must not become 1 cm after 50 ms."""
    stamps_ns = [k * 5 * MS for k in range(60)]
    poses = [IDENTITY.copy() for _ in stamps_ns]
    poses[-1][0, 3] = 1e-3
    T = at(prior_of(stamps_ns, poses), stamps_ns[-1] + 50 * MS)
    assert T is not None
    assert abs(T[0, 3]) < 1.5e-3


def test_no_pose_in_a_gap_before_the_first_pose_or_in_an_empty_buffer() -> None:
    prior = prior_of([0, 260 * MS], [IDENTITY, se3.exp(FORWARD)])
    assert at(prior, 100 * MS) is None
    assert at(prior, -1) is None
    assert at(OdometryPriorBuffer(), 0) is None
    assert at(prior, 260 * MS) is not None


def test_buffer_is_bounded() -> None:
    prior = prior_of([k * MS for k in range(3 * KEPT)], [IDENTITY] * (3 * KEPT))
    assert len(prior.poses) == KEPT
    assert prior.poses[-1].stamp_ns == (3 * KEPT - 1) * MS


# --- unusable poses -------------------------------------------------------------------------------
JUMP = se3.exp(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
SPIN = se3.exp(np.array([0.0, 2.5, 0.0, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("stamp_ns", "T", "check"),
    [
        (2_000 * MS, IDENTITY, PriorCheck.LATE),
        (1_900 * MS, IDENTITY, PriorCheck.LATE),
        (2_100 * MS, np.full((4, 4), np.nan), PriorCheck.BROKEN),
        (900 * MS, IDENTITY, PriorCheck.RESTARTED),
        (2_100 * MS, JUMP, PriorCheck.JUMPED),
        (2_100 * MS, SPIN, PriorCheck.JUMPED),
    ],
)
def test_inconsistent_pose_is_rejected_or_starts_a_session(stamp_ns, T, check) -> None:
    before = prior_of([1_900 * MS, 2_000 * MS], [IDENTITY, IDENTITY])
    after, found = before.added(stamp_ns, T, CONFIG)
    assert found is check
    if check in (PriorCheck.LATE, PriorCheck.BROKEN):
        assert after is before
    else:
        assert [pose.stamp_ns for pose in after.poses] == [stamp_ns]
        assert after.session == before.session + 1


@pytest.mark.parametrize(
    "fields",
    [{"max_gap_s": 0.0}, {"max_extrapolation_s": -1.0}, {"max_dead_reckoning_s": float("nan")}],
)
def test_impossible_settings_are_rejected(fields) -> None:
    with pytest.raises(ConfigError):
        PriorConfig(**fields)


# --- motion between two readings ------------------------------------------------------------------
def test_dead_reckoning_does_not_depend_on_prior_frame_and_mounting() -> None:
    T_base_camera = se3.exp(np.array([0.3, -1.2, 0.4, 0.2, 0.0, 0.5]))
    T_prior_world = se3.exp(np.array([1.0, 0.5, -0.2, 7.0, 3.0, -2.0]))
    T_world_camera = [IDENTITY, se3.exp(FORWARD)]
    T_prior_base = [T_prior_world @ T @ se3.inverse(T_base_camera) for T in T_world_camera]
    prior = prior_of([0, 200 * MS], T_prior_base)
    then, now = (prior.at(ns, T_base_camera, CONFIG) for ns in (0, 200 * MS))
    assert then is not None
    assert now is not None
    T_odom_camera = se3.exp(np.array([0.1, 0.0, 0.2, 1.0, 2.0, 3.0]))
    dead_reckoned = DeadReckoningStart(T_odom_camera, then).dead_reckon(now, CONFIG)
    np.testing.assert_allclose(dead_reckoned, T_odom_camera @ T_world_camera[1], atol=1e-12)


def test_dead_reckoning_ends_at_a_new_session_and_at_its_time_limit() -> None:
    start = DeadReckoningStart(IDENTITY, PriorPose(0, IDENTITY, session=1))
    assert start.dead_reckon(PriorPose(10 * MS, IDENTITY, session=2), CONFIG) is None
    assert start.dead_reckon(PriorPose(31_000 * MS, IDENTITY, session=1), CONFIG) is None
    assert start.dead_reckon(PriorPose(29_000 * MS, IDENTITY, session=1), CONFIG) is not None


# --- tracking with a covered lens -----------------------------------------------------------------
BEFORE, COVERED, AFTER = 8, 22, 6
# SIFT relocalizes the camera in these views too, at many times the cost.
WITHOUT_SIFT = OdometryConfig(relocalization=RelocalizationConfig(across_scales=0))


@dataclass(frozen=True)
class CoveredWalk:
    """A walk with a covered lens in the middle, during which the images show no motion."""

    frames: list[RgbdFrame]
    T_world_camera: list[np.ndarray]

    def track(
        self, poses: list[np.ndarray] | None, config: OdometryConfig | None = None
    ) -> list[TrackingResult]:
        config = replace(
            config or OdometryConfig(), keyframes=KeyframeConfig(mapping_only_ratio=2.0)
        )
        odometry, prior, results = Odometry(config), OdometryPriorBuffer(), []
        for k, frame in enumerate(self.frames):
            if poses is not None:
                prior, _ = prior.added(frame.stamp_ns, poses[k], CONFIG)
            results.append(odometry.process(frame, prior))
        return results


@pytest.fixture(scope="module")
def covered_walk(room, make_walk) -> CoveredWalk:
    truth = make_walk(BEFORE + COVERED + AFTER, 0.03, 0.015)
    frames = [
        room.blank(k, k * PERIOD_NS)
        if BEFORE <= k < BEFORE + COVERED
        else room.view(T, stamp_ns=k * PERIOD_NS, index=k)
        for k, T in enumerate(truth)
    ]
    return CoveredWalk(frames, truth)


def drifting(truth: list[np.ndarray], drift: float = 0.02, noise: float = 0.0) -> list[np.ndarray]:
    """Return the walk in a frame of its own, with noisy steps that are too long by a fraction."""
    rng, poses = np.random.default_rng(0), [se3.exp(np.array([0.0, 1.0, 0.0, 5.0, 0.0, 0.0]))]
    for a, b in pairwise(truth):
        step = (1 + drift) * se3.log(se3.inverse(a) @ b) + noise * rng.normal(size=6)
        poses.append(poses[-1] @ se3.exp(step))
    return poses


GOOD_PRIORS: dict[str, Callable[[list[np.ndarray]], list[np.ndarray]]] = {
    "true": lambda truth: truth,
    "2 % of drift": drifting,
    "10 % of drift": lambda truth: drifting(truth, 0.10),
    "noisy": lambda truth: drifting(truth, noise=0.003),
}
WRONG_PRIORS: dict[str, Callable[[list[np.ndarray]], list[np.ndarray]]] = {
    "stands still": lambda truth: [truth[0]] * len(truth),
    "goes backwards": lambda truth: [se3.inverse(T) for T in truth],
    "jumps": lambda truth: [T @ JUMP if k % 2 else T for k, T in enumerate(truth)],
    "is random": lambda truth: drifting(truth, 0.0, noise=0.1),
    "is broken": lambda truth: [np.full((4, 4), np.nan)] * len(truth),
}


def statuses(results: list[TrackingResult]) -> list[TrackingStatus]:
    return [tracked.status for tracked in results]


def largest_ok_error_m(covered_walk: CoveredWalk, results: list[TrackingResult]) -> float:
    return max(
        float(np.linalg.norm(tracked.T_odom_camera[:3, 3] - T[:3, 3]))
        for tracked, T in zip(results, covered_walk.T_world_camera, strict=True)
        if tracked.status is TrackingStatus.OK
    )


@pytest.mark.parametrize("name", GOOD_PRIORS)
def test_covered_camera_is_found_at_once_with_a_prior(covered_walk: CoveredWalk, name: str) -> None:
    alone = covered_walk.track(None, WITHOUT_SIFT)
    assert statuses(alone)[BEFORE:] == [TrackingStatus.LOST] * (COVERED + AFTER)
    results = covered_walk.track(GOOD_PRIORS[name](covered_walk.T_world_camera), WITHOUT_SIFT)
    assert (
        statuses(results)[BEFORE:] == [TrackingStatus.LOST] * COVERED + [TrackingStatus.OK] * AFTER
    )
    assert "prior" in {tracked.pose_source for tracked in results}
    assert largest_ok_error_m(covered_walk, results) < 5e-3


@pytest.mark.parametrize("name", WRONG_PRIORS)
def test_wrong_prior_changes_no_status_and_no_pose(covered_walk: CoveredWalk, name: str) -> None:
    alone = covered_walk.track(None)
    results = covered_walk.track(WRONG_PRIORS[name](covered_walk.T_world_camera))
    assert statuses(results) == statuses(alone)
    assert largest_ok_error_m(covered_walk, results) < 5e-3


def test_covered_frames_are_lost_at_the_last_ok_pose_despite_a_prior(
    covered_walk: CoveredWalk,
) -> None:
    results = covered_walk.track(covered_walk.T_world_camera)
    last = results[BEFORE - 1].T_odom_camera
    for tracked in results[BEFORE : BEFORE + COVERED]:
        assert (tracked.status, tracked.pose_source) == (TrackingStatus.LOST, "none")
        np.testing.assert_array_equal(tracked.T_odom_camera, last)
        assert not tracked.information.any()


def test_new_submap_starts_at_the_pose_of_the_prior(room, make_walk) -> None:
    """The camera turns around while it is covered, to a view it has never seen."""
    truth, turn = make_walk(BEFORE), np.array([0.0, np.pi, 0.0, 0.3, 0.0, 0.0])
    truth += [truth[-1] @ se3.exp(min(k / COVERED, 1.0) * turn) for k in range(1, COVERED + AFTER)]
    frames = [
        room.blank(k, k * PERIOD_NS)
        if BEFORE <= k < BEFORE + COVERED
        else room.view(T, stamp_ns=k * PERIOD_NS, index=k)
        for k, T in enumerate(truth)
    ]
    turned = CoveredWalk(frames, truth)
    config = OdometryConfig(submaps=SubmapConfig(begin_after_frames=1))
    alone, helped = turned.track(None, config), turned.track(drifting(truth), config)
    for results in (alone, helped):
        assert {tracked.submap for tracked in results[BEFORE + COVERED :]} == {1}
    assert largest_ok_error_m(turned, helped) < 0.02
    assert largest_ok_error_m(turned, alone) > 0.1, (
        "without a prior, the submap starts at the last pose"
    )


def test_fast_camera_is_tracked_with_a_prior(room, make_walk) -> None:
    """The frames are 12 cm apart, at 5 Hz."""
    truth = make_walk(6, 0.12, 0.08)
    frames = [room.view(T, stamp_ns=k * 200 * MS, index=k) for k, T in enumerate(truth)]
    walk = CoveredWalk(frames, truth)
    assert TrackingStatus.LOST in statuses(walk.track(None, WITHOUT_SIFT))
    assert statuses(walk.track(drifting(truth), WITHOUT_SIFT)) == [TrackingStatus.OK] * 6


# --- state ----------------------------------------------------------------------------------------
def test_prior_and_dead_reckoning_start_are_restored_bitwise_equal() -> None:
    prior = prior_of([0, 100 * MS], [IDENTITY, se3.exp(FORWARD)])
    restored = OdometryPriorBuffer.unpack(decode_state(encode_state(prior.pack())))
    assert encode_state(restored.pack()) == encode_state(prior.pack())
    reading = prior.at(50 * MS, IDENTITY, CONFIG)
    assert reading is not None
    start = DeadReckoningStart(se3.exp(FORWARD), reading)
    restored_start = DeadReckoningStart.unpack(decode_state(encode_state(start.pack())))
    assert encode_state(restored_start.pack()) == encode_state(start.pack())


def test_tracker_restored_while_covered_continues_bitwise_equal(covered_walk: CoveredWalk) -> None:
    prior = prior_of([k * PERIOD_NS for k in range(36)], covered_walk.T_world_camera)
    first, second = Odometry(), Odometry()
    for k, frame in enumerate(covered_walk.frames):
        if k == BEFORE + 5:
            second.restore(decode_state(encode_state(first.snapshot())))
        expected = first.process(frame, prior)
        if k >= BEFORE + 5:
            tracked = second.process(frame, prior)
            assert tracked.T_odom_camera.tobytes() == expected.T_odom_camera.tobytes()
            assert (tracked.status, tracked.pose_source) == (expected.status, expected.pose_source)
    assert expected.status is TrackingStatus.OK
