from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import RgbdFrame, Trajectory, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import Odometry, OdometryConfig, TrackingResult, TrackingStatus
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.submaps import SubmapConfig
from ldo_service.tracking.tracking_result import KeyframeKind

T_ELSEWHERE = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))


def track(odometry: Odometry, frames: Sequence[RgbdFrame]) -> list[TrackingResult]:
    return [odometry.process(frame) for frame in frames]


def became_reference(result: TrackingResult) -> bool:
    """Return whether the next frames are aligned to this one."""
    return result.keyframe is not None and result.keyframe.kind is not KeyframeKind.MAPPING


def largest_error_m(results: Sequence[TrackingResult], truth: Sequence[np.ndarray]) -> float:
    return max(
        float(np.linalg.norm(r.T_odom_camera[:3, 3] - T[:3, 3]))
        for r, T in zip(results, truth, strict=True)
    )


def assert_bitwise_equal(a: Sequence[TrackingResult], b: Sequence[TrackingResult]) -> None:
    for x, y in zip(a, b, strict=True):
        assert x.T_odom_camera.tobytes() == y.T_odom_camera.tobytes()
        assert x.information.tobytes() == y.information.tobytes()
        assert (x.status, x.pose_source) == (y.status, y.pose_source)
        assert became_reference(x) == became_reference(y)


def test_walk_is_tracked_and_keyframes_are_made(room, make_walk) -> None:
    truth = make_walk(25)
    results = track(Odometry(), [room.view(T, index=k) for k, T in enumerate(truth)])
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert largest_error_m(results, truth) < 5e-3
    assert 2 < sum(map(became_reference, results)) < 14
    keyframes = [index for index, r in enumerate(results) if r.keyframe is not None]
    last = results[-1]
    assert last.reference is not None
    between = se3.inverse(truth[keyframes[last.reference]]) @ truth[-1]
    np.testing.assert_allclose(last.T_reference_camera, between, atol=2e-3)


def test_wrong_stamps_do_not_decide_about_poses_and_submaps(room, make_walk) -> None:
    config = OdometryConfig(submaps=SubmapConfig(begin_after_frames=6))
    truth = make_walk(24)
    truth[8:] = [T @ T_ELSEWHERE for T in truth[8:]]

    def tracked(interval_ns: int) -> list[TrackingResult]:
        stamps_ns = [k * interval_ns for k in range(len(truth))]
        views = [
            room.view(T, stamp_ns=s, index=k)
            for k, (T, s) in enumerate(zip(truth, stamps_ns, strict=True))
        ]
        return track(Odometry(config), views)

    fast, slow = tracked(1_000), tracked(2_000_000_000)
    assert_bitwise_equal(fast, slow)
    assert [r.submap for r in fast] == [r.submap for r in slow]
    assert {r.status for r in fast[8:9]} == {TrackingStatus.LOST}
    assert fast[-1].submap == 1


def test_tracking_continues_when_no_keyframe_may_be_made(room, make_walk) -> None:
    truth = make_walk(16)
    odometry = Odometry()
    odometry.process(room.view(truth[0]))
    results = [odometry.process(room.view(T), may_map=False) for T in truth[1:]]
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert largest_error_m(results, truth[1:]) < 5e-3
    assert all(r.keyframe is None for r in results)
    assert all(r.denied_keyframe is KeyframeKind.REFERENCE for r in results[-5:])


def test_camera_is_tracked_far_from_its_keyframe_when_no_keyframe_may_be_made(large_room) -> None:
    """The camera turns by 130 degrees, until nothing of the keyframe is in view."""
    truth = [se3.exp(np.array([0.0, 0.12 * k, 0.0, 0.0, 0.0, 0.0])) for k in range(20)]
    frames = [large_room.view(T, index=k) for k, T in enumerate(truth)]
    odometry, restored = Odometry(), Odometry()
    odometry.process(frames[0])
    results = [odometry.process(frame, may_map=False) for frame in frames[1:12]]
    restored.restore(decode_state(encode_state(odometry.snapshot())))
    results += [odometry.process(frame, may_map=False) for frame in frames[12:19]]
    again = [restored.process(frame, may_map=False) for frame in frames[12:19]]
    assert_bitwise_equal(again, results[11:])
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert {r.reference for r in results} == {0}
    assert largest_error_m(results, truth[1:19]) < 0.01
    np.testing.assert_allclose(results[-1].T_reference_camera, truth[18], atol=0.01)
    sigmas = [np.sqrt(np.linalg.inv(r.information).trace()) for r in results]
    assert sigmas[-1] > 2 * sigmas[0]
    last = odometry.process(frames[19])
    assert became_reference(last)
    assert last.reference == 0


def test_every_usable_frame_is_first_until_a_keyframe_is_made(room) -> None:
    odometry = Odometry()
    assert odometry.process(room.blank()).status is TrackingStatus.LOST
    for _ in range(2):
        result = odometry.process(room.view(np.eye(4)), may_map=False)
        assert (result.status, result.pose_source) == (TrackingStatus.OK, "first")
        assert result.denied_keyframe is KeyframeKind.FIRST
        assert result.awaits_mapping
    result = odometry.process(room.view(np.eye(4)))
    assert result.keyframe is not None
    assert (result.keyframe.kind, result.reference) == (KeyframeKind.FIRST, result.keyframe.id)
    assert not result.awaits_mapping


def test_missed_frames_are_bridged(room, make_walk) -> None:
    truth = [T for k, T in enumerate(make_walk(24)) if not 10 <= k < 14]
    results = track(Odometry(), [room.view(T, index=k) for k, T in enumerate(truth)])
    assert largest_error_m(results, truth) < 5e-3


def test_steps_beyond_the_reach_of_direct_alignment_are_found_by_features(large_room) -> None:
    step = se3.exp(np.array([0.0, 0.3, 0.0, 0.25, 0.0, 0.0]))
    truth = [np.linalg.matrix_power(step, k) for k in range(4)]
    results = track(Odometry(), [large_room.view(T, index=k) for k, T in enumerate(truth)])
    assert largest_error_m(results, truth) < 5e-3
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert "features" in {r.pose_source for r in results}


def test_repeated_frame_keeps_its_pose(room, make_walk) -> None:
    frames = [room.view(T, stamp_ns=k * 33_000_000) for k, T in enumerate(make_walk(6))]
    odometry = Odometry()
    moving = track(odometry, frames)
    still = track(odometry, [frames[-1]] * 4)
    assert {r.status for r in still} == {TrackingStatus.OK}
    for r in still:
        np.testing.assert_allclose(r.T_odom_camera, moving[-1].T_odom_camera, atol=1e-3)


def test_frame_without_depth_is_weak_and_does_not_break_the_track(room, make_walk) -> None:
    truth = make_walk(12)
    frames = [room.view(T) for T in truth]
    frames[6] = replace(frames[6], depth_m=np.zeros_like(frames[6].depth_m))
    results = track(Odometry(), frames)
    assert results[6].status is TrackingStatus.WEAK
    assert results[6].keyframe is None
    assert results[-1].status is TrackingStatus.OK
    assert largest_error_m(results, truth) < 5e-3


def test_blank_frame_is_not_ok_and_the_next_frame_is_tracked(large_room, make_walk) -> None:
    truth = make_walk(8)
    frames = [large_room.view(T) for T in truth]
    frames[5] = large_room.blank()
    results = track(Odometry(), frames)
    assert results[5].status is not TrackingStatus.OK
    assert results[-1].status is TrackingStatus.OK
    assert largest_error_m(results[6:], truth[6:]) < 5e-3


def test_kidnapped_camera_is_lost_and_relocalizes_on_return(large_room, make_walk) -> None:
    odometry = Odometry()
    track(odometry, [large_room.view(T, index=k) for k, T in enumerate(make_walk(8))])
    before = odometry.process(large_room.view(make_walk(8)[-1]), may_map=False)
    elsewhere = [odometry.process(large_room.view(T_ELSEWHERE @ T)) for T in make_walk(5)]
    assert {r.status for r in elsewhere} == {TrackingStatus.LOST}
    for r in elsewhere:  # The pose does not jump.
        np.testing.assert_array_equal(r.T_odom_camera, before.T_odom_camera)
        assert not r.information.any()
    T_back = make_walk(3)[-1] @ se3.exp(np.array([0.0, -0.1, 0.05, -0.1, 0.0, 0.05]))
    back = odometry.process(large_room.view(T_back), may_map=False)
    assert back.status is TrackingStatus.OK
    np.testing.assert_allclose(back.T_odom_camera, T_back, atol=5e-3)


def test_lost_frame_cannot_become_a_keyframe(room) -> None:
    odometry = Odometry()
    for frame in (room.blank(), room.view(np.eye(4)), room.blank()):
        result = odometry.process(frame)
        is_lost = result.status is TrackingStatus.LOST
        assert (result.keyframe is None) is is_lost
        assert result.denied_keyframe is None
    assert is_lost


def test_two_runs_are_bitwise_equal(large_room, make_walk) -> None:
    frames = [large_room.view(T) for T in make_walk(8, step_m=0.08, step_rad=0.05)]
    assert_bitwise_equal(track(Odometry(), frames), track(Odometry(), frames))


def test_restored_odometry_continues_bitwise_equal(large_room, make_walk) -> None:
    frames = [large_room.view(T, index=k) for k, T in enumerate(make_walk(14, 0.05, 0.03))]
    odometry = Odometry()
    track(odometry, frames[:7])
    state = odometry.snapshot()
    expected = track(odometry, [*frames[7:10], large_room.blank(), *frames[10:]])
    restored = Odometry()
    restored.restore(state)
    assert_bitwise_equal(
        track(restored, [*frames[7:10], large_room.blank(), *frames[10:]]), expected
    )


def test_state_survives_encoding(large_room, make_walk) -> None:
    frames = [large_room.view(T) for T in make_walk(8, 0.05, 0.03)]
    odometry, restored = Odometry(), Odometry()
    track(odometry, frames[:6])
    restored.restore(decode_state(encode_state(odometry.snapshot())))
    rest = [large_room.blank(), *frames[6:]]
    assert_bitwise_equal(track(restored, rest), track(odometry, rest))


def test_camera_relocalizes_in_an_old_keyframe(large_room) -> None:
    """Tracking continues against the old keyframe, nine keyframes later and after a restart."""
    turns = [se3.exp(np.array([0.0, 0.12 * k, 0.0, 0.0, 0.0, 0.0])) for k in range(20)]
    odometry = Odometry()
    out = track(odometry, [large_room.view(T) for T in turns])
    assert {r.status for r in out} == {TrackingStatus.OK}
    assert sum(map(became_reference, out)) >= 9
    walk = [se3.exp(np.array([0.0, 0.05, 0.0, 0.01 * k, 0.0, 0.02])) for k in range(8)]
    frames = [large_room.view(T) for T in walk]
    back = odometry.process(frames[0], may_map=False)
    assert (back.status, back.pose_source) == (TrackingStatus.OK, "relocalized")
    assert back.reference in (0, 1)
    np.testing.assert_allclose(back.T_odom_camera, walk[0], atol=0.01)
    restored = Odometry()
    restored.restore(decode_state(encode_state(odometry.snapshot())))
    after = track(odometry, frames[1:])
    assert {r.status for r in after} == {TrackingStatus.OK}
    assert largest_error_m(after, walk[1:]) < 0.01
    assert_bitwise_equal(track(restored, frames[1:]), after)


def test_lost_camera_relocalizes_in_the_last_mapped_frame(large_room) -> None:
    """The view has left the reference keyframe; the restored tracker finds the same pose."""
    rarely = KeyframeConfig(
        min_overlap=0.0, max_frames=1000, max_rotation_rad=np.pi, max_translation=100.0,
        mapping_only_ratio=0.1,
    )  # fmt: skip
    turned = [se3.exp(np.array([0.0, 0.06 * k, 0.0, 0.0, 0.0, 0.0])) for k in range(20)]
    odometry, restored = (Odometry(OdometryConfig(keyframes=rarely)) for _ in range(2))
    known = track(odometry, [large_room.view(T) for T in turned[:13]])
    assert [*map(became_reference, known)] == [True] + 12 * [False]
    restored.restore(decode_state(encode_state(odometry.snapshot())))
    frames = [large_room.blank(), large_room.view(turned[-1])]
    *_, found = track(odometry, frames)
    assert (found.status, found.pose_source) == (TrackingStatus.OK, "relocalized")
    np.testing.assert_allclose(found.T_odom_camera, turned[-1], atol=0.01)
    assert_bitwise_equal(track(restored, frames)[-1:], [found])


@pytest.mark.parametrize("size", [(161, 121), (80, 60), (128, 128), (97, 200)])
def test_odd_sizes_are_tracked(make_room, make_walk, size: tuple[int, int]) -> None:
    room, truth = make_room(*size), make_walk(8)
    results = track(Odometry(), [room.view(T) for T in truth])
    assert largest_error_m(results, truth) < 0.02
    assert {r.status for r in results} == {TrackingStatus.OK}


def test_motion_limit_of_zero_is_rejected() -> None:
    with pytest.raises(ConfigError, match="large_motion"):
        OdometryConfig(large_motion=0.0)


def test_forty_real_frames_stay_within_three_centimeters(data: Path) -> None:
    kitchen = open_sequence(str(data / "tum" / "kitchen"))
    results = track(Odometry(), [kitchen[index] for index in range(40)])
    assert {r.status for r in results} == {TrackingStatus.OK}
    T_odom_camera = np.array([r.T_odom_camera for r in results])
    truth = kitchen.truth()
    assert truth is not None
    estimate = Trajectory(kitchen.stamps_ns[:40] * 1e-9, T_odom_camera)
    assert evaluate_trajectory(estimate, truth).ate_m.rmse < 0.03


@pytest.mark.parametrize("name", ["lounge_part", "office_part"])
def test_real_camera_with_large_steps_or_in_a_dim_room_is_not_lost(data: Path, name: str) -> None:
    """The thresholds were chosen on these sequences, so this test only detects a regression."""
    folder = data / "scannet" / name
    if not folder.is_dir():
        pytest.skip(f"LDO_DATA has no scannet/{name}")
    sequence = open_sequence(str(folder))
    results = track(Odometry(), list(sequence))
    statuses = [r.status for r in results]
    assert TrackingStatus.LOST not in statuses
    assert statuses.count(TrackingStatus.OK) >= 0.95 * len(statuses)
    truth = sequence.truth()
    assert truth is not None
    T_odom_camera = np.array([r.T_odom_camera for r in results])
    estimate = Trajectory(sequence.stamps_ns * 1e-9, T_odom_camera)
    assert evaluate_trajectory(estimate, truth).ate_m.rmse < 0.02
