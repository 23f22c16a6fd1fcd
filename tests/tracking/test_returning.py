"""Keyframe reuse: which known keyframes are used, and how odometry continues on them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from ldo_service.detection.dynamic_classes import Box
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import (
    AlignConfig,
    Odometry,
    OdometryConfig,
    PyramidConfig,
    TrackingResult,
    TrackingStatus,
    pyramid_of,
)
from ldo_service.tracking.keyframe_database import KeyframeRecord
from ldo_service.tracking.keyframe_reuse import (
    KeyframeReuse,
    KeyframeReuseConfig,
    find_nearby_keyframes,
)
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.map_frame import MapCorrection
from ldo_service.tracking.state import KeyframeOrigin
from ldo_service.tracking.tracking_quality import ResidualHistory, TrackingQualityConfig
from ldo_service.tracking.tracking_result import KeyframeKind
from tests.tracking.scenes import record_at

REUSE_EARLY = OdometryConfig(keyframe_reuse=KeyframeReuseConfig(after=1))


def moved(x_m: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([0.0, turn_rad, 0.0, x_m, 0.0, 0.0]))


def record_of(room, keyframe_id: int) -> KeyframeRecord:
    """Return a record at the identity with a median depth of 2 m."""
    return replace(record_at(room, np.eye(4), keyframe_id), median_depth_m=2.0)


def correction_of(T_map_keyframe: Mapping[int, np.ndarray]) -> MapCorrection:
    return MapCorrection(1, {}, lambda _: T_map_keyframe)


def connect(odometry: Odometry) -> None:
    """Mark the reference as measured from a known keyframe, as one more keyframe would."""
    frames = odometry._frames
    frames.state = replace(frames.state, origin=KeyframeOrigin.MEASURED)


def track(
    odometry: Odometry, room, poses: list[np.ndarray]
) -> tuple[list[TrackingResult], dict[int, np.ndarray]]:
    """Track along poses; also return the true T_odom_keyframe [4, 4] of each new keyframe."""
    results, keyframes = [], {}
    for index, T in enumerate(poses):
        results.append(odometry.process(room.view(T, index=index)))
        if results[-1].keyframe is not None:
            keyframes[results[-1].keyframe.id] = T
    return results, keyframes


# --- nearby records -------------------------------------------------------------------------------
def test_nearby_records_are_within_keyframe_limits_nearest_first(room) -> None:
    config = KeyframeConfig(max_translation=0.1, max_rotation_rad=0.2)  # 0.2 m at a depth of 2 m.
    records = [record_of(room, number) for number in range(5)]
    T_map = {0: moved(0.19), 1: moved(0.21), 2: moved(-0.05), 3: moved(0, 0.15), 4: moved(0, -0.25)}
    near = find_nearby_keyframes(records, T_map, np.eye(4), config)
    assert [record.id for record, _ in near] == [2, 3, 0]
    for record, T_record_camera in near:
        np.testing.assert_allclose(T_map[record.id] @ T_record_camera, np.eye(4), atol=1e-12)


def test_records_without_a_map_pose_are_skipped(room) -> None:
    records = [record_of(room, number) for number in range(2)]
    assert [
        p.id for p, _ in find_nearby_keyframes(records, {1: np.eye(4)}, np.eye(4), KeyframeConfig())
    ] == [1]
    assert find_nearby_keyframes(records, {}, np.eye(4), KeyframeConfig()) == []


def first_frame_that_needs_a_keyframe(
    odometry: Odometry, room, outward: list[np.ndarray]
) -> tuple[TrackingResult, np.ndarray]:
    """Walk back; return the first frame that needs a new reference, and its true pose."""
    for T in reversed(outward[:-1]):
        result = odometry.process(room.view(T), may_map=False)
        if result.denied_keyframe is KeyframeKind.REFERENCE:
            return result, T
    raise AssertionError("no frame on the way back needs a new reference keyframe")


# --- odometry -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ReturnedCamera:
    """A camera that returned to mapped keyframes, one of which it needs as its reference."""

    odometry: Odometry
    correction: MapCorrection
    without_map: TrackingResult  # Result of the same frame without a map.
    result: TrackingResult


def walk_out_and_return(room, make_walk, T_error: np.ndarray) -> ReturnedCamera:
    """Walk out and return to where a keyframe is needed, in a map that is off by T_error."""
    odometry, alone, outward = Odometry(REUSE_EARLY), Odometry(REUSE_EARLY), make_walk(20)
    _, T_map = track(odometry, room, outward)
    due, T = first_frame_that_needs_a_keyframe(odometry, room, outward)
    alone.restore(odometry.snapshot())
    assert due.reference is not None
    T_map[due.reference] = T @ T_error @ se3.inverse(due.T_reference_camera)
    correction = correction_of(T_map)
    assert odometry.correct(correction)
    connect(odometry)
    frame = room.view(T)
    without_map = alone.process(frame, may_map=False)
    return ReturnedCamera(odometry, correction, without_map, odometry.process(frame, may_map=False))


def test_keyframe_reuse_keeps_the_odometry_pose(room, make_walk) -> None:
    back = walk_out_and_return(room, make_walk, np.eye(4))
    returned, without_map = back.result, back.without_map
    assert without_map.denied_keyframe is KeyframeKind.REFERENCE
    assert returned.reused_keyframe is not None
    assert returned.reference == returned.reused_keyframe == back.odometry.reference
    assert returned.reference != without_map.reference
    assert (returned.status, returned.pose_source) == (TrackingStatus.OK, "reused")
    assert (returned.keyframe, returned.denied_keyframe) == (None, None)
    np.testing.assert_array_equal(returned.T_odom_camera, without_map.T_odom_camera)
    following = back.odometry.process(room.view(returned.T_odom_camera))
    assert (following.reference, following.keyframe) == (returned.reference, None)
    np.testing.assert_allclose(following.T_odom_camera, returned.T_odom_camera, atol=3e-3)


def test_view_of_a_reused_keyframe_is_not_mapped_again(room, make_walk) -> None:
    back = walk_out_and_return(room, make_walk, np.eye(4))
    odometry, returned = back.odometry, back.result
    step = se3.exp(np.array([0, 0.1, 0, 0, 0, 0]))  # Large enough to be mapped otherwise.
    tracked = odometry.process(room.view(returned.T_odom_camera @ step), may_map=False)
    assert tracked.reference == returned.reference
    assert tracked.status is TrackingStatus.OK
    assert tracked.denied_keyframe in (None, KeyframeKind.REFERENCE)
    aside = tracked.T_odom_camera @ moved(turn_rad=0.3)  # Away from known keyframes.
    for T in (aside, aside):
        tracked = odometry.process(room.view(T))
    assert odometry.reference is not None
    assert odometry.reference > max(back.correction.read_poses(None))
    ahead = odometry.process(room.view(tracked.T_odom_camera @ step))
    assert ahead.keyframe is not None, "views near a new keyframe are mapped"


def test_no_reuse_where_map_and_images_disagree(room, make_walk) -> None:
    back = walk_out_and_return(room, make_walk, moved(turn_rad=0.06))
    assert back.result.reused_keyframe is None
    assert back.result.denied_keyframe is KeyframeKind.REFERENCE


def test_no_reuse_before_a_keyframe_is_measured_from_a_known_one(room, make_walk) -> None:
    odometry, outward = Odometry(REUSE_EARLY), make_walk(20)
    _, T_map = track(odometry, room, outward)
    due, T = first_frame_that_needs_a_keyframe(odometry, room, outward)
    odometry.correct(correction_of(T_map))
    result = odometry.process(room.view(T))
    assert (result.reused_keyframe, result.reference) == (None, due.reference)
    assert result.keyframe is not None
    assert result.keyframe.kind is KeyframeKind.REFERENCE
    first, *others = result.keyframe.window
    assert first.a not in {other.a for other in others}
    T_true = se3.inverse(T_map[first.a]) @ T
    np.testing.assert_allclose(first.T_a_b, T_true, atol=5e-3)
    assert odometry._is_connected_to_map


def test_no_reuse_of_a_keyframe_that_looks_different_now(room) -> None:
    reuse = KeyframeReuse(
        PyramidConfig(),
        AlignConfig(),
        KeyframeConfig(),
        TrackingQualityConfig(),
        KeyframeReuseConfig(),
    )
    near = [(record_of(room, 0), np.eye(4))]
    blank, same = (pyramid_of(f, PyramidConfig()) for f in (room.blank(), room.view(np.eye(4))))
    assert reuse.find(blank, near, ResidualHistory()) is None
    assert reuse.find(same, near, ResidualHistory()) is not None


def test_restored_tracker_continues_bitwise_equal_after_reuse(room, make_walk) -> None:
    back = walk_out_and_return(room, make_walk, np.eye(4))
    odometry, restored = back.odometry, Odometry(REUSE_EARLY)
    assert back.result.reused_keyframe is not None
    state = decode_state(encode_state(odometry.snapshot()))
    restored.restore(state, back.correction)
    for step in (0.01, 0.03, 0.06):
        view = room.view(back.result.T_odom_camera @ moved(step))
        a, b = odometry.process(view), restored.process(view)
        assert a.T_odom_camera.tobytes() == b.T_odom_camera.tobytes()
        assert a.T_map_odom.tobytes() == b.T_map_odom.tobytes()
        assert (a.reference, a.reused_keyframe) == (b.reference, b.reused_keyframe)
        assert (a.keyframe is None) == (b.keyframe is None)


def test_keyframe_made_after_reuse_is_measured_from_the_reused_ones(room, make_walk) -> None:
    """Odometry poses of the records have changed, as after drift, and the window must use them."""
    odometry, outward = Odometry(REUSE_EARLY), make_walk(45)
    _, T_map = track(odometry, room, outward)
    state = odometry._frames.state
    far = tuple(
        replace(p, T_odom_keyframe=moved(0.4) @ p.T_odom_keyframe) for p in state.database.all
    )
    odometry._frames.state = replace(state, database=replace(state.database, all=far))
    odometry.correct(correction_of(T_map))
    connect(odometry)
    back = [odometry.process(room.view(T)) for T in reversed(outward[:-1])]
    assert [result.keyframe for result in back] == [None] * len(back)
    reused = {result.reused_keyframe for result in back if result.reused_keyframe is not None}
    assert len(reused) > 2
    aside = room.view(outward[0] @ moved(turn_rad=0.3))
    for _ in range(2):
        result = odometry.process(aside)
        if result.keyframe is not None:
            break
    assert result.keyframe is not None
    assert result.keyframe.kind is KeyframeKind.REFERENCE
    window = result.keyframe.window
    assert {measured.a for measured in window} <= reused
    assert window
    for measured in window:
        assert measured.b == result.keyframe.id
        T_true = se3.inverse(T_map[measured.a]) @ outward[0] @ moved(turn_rad=0.3)
        np.testing.assert_allclose(measured.T_a_b, T_true, atol=1e-2)


@pytest.mark.parametrize(
    "wrong",
    [{"after": -1}, {"tries": 0}, {"agreement_rad": 0.0}, {"min_geometric_inliers": 1.5}],
)
def test_impossible_settings_are_rejected(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        KeyframeReuseConfig(**wrong)


def test_slow_camera_stays_with_the_reused_keyframe(room, make_walk) -> None:
    """A new keyframe is replaced after some frames; a reused one is not."""
    back = walk_out_and_return(room, make_walk, np.eye(4))
    assert back.result.reused_keyframe is not None
    steps = [back.result.T_odom_camera @ moved(5e-4 * k, 2e-3 * (k % 2)) for k in range(40)]
    results, keyframes = track(back.odometry, room, steps)
    assert keyframes == {}
    assert {result.reference for result in results} == {back.result.reference}


def test_object_added_after_a_reused_keyframe_is_not_dynamic(room, make_walk) -> None:
    back = walk_out_and_return(room, make_walk, np.eye(4))
    assert back.result.reused_keyframe is not None
    tracked = back.odometry.process(with_a_box(room.view(back.result.T_odom_camera)))
    assert tracked.status is TrackingStatus.OK
    assert tracked.reference == back.result.reference
    assert tracked.dynamic_mask is None


def test_object_that_appears_after_a_new_keyframe_is_dynamic(room) -> None:
    odometry = Odometry(REUSE_EARLY)
    odometry.process(room.view(np.eye(4)))
    tracked = odometry.process(with_a_box(room.view(np.eye(4))))
    assert tracked.dynamic_mask is not None
    assert tracked.dynamic_mask[55, 75]


def with_a_box(frame: RgbdFrame) -> RgbdFrame:
    color, depth_m = frame.color.copy(), frame.depth_m.copy()
    color[40:70, 60:90] = np.random.default_rng(0).integers(60, 200, (30, 30, 1))
    depth_m[40:70, 60:90] = 1.0
    return replace(frame, color=color, depth_m=depth_m)


def test_detected_person_is_removed_from_the_keyframe_record(room) -> None:
    odometry = Odometry(REUSE_EARLY)
    frame = room.view(np.eye(4))
    number = odometry.process(frame).reference
    assert number is not None
    before = odometry._frames.state.database.all[0]
    odometry.mask_dynamic_objects(number, [Box("person", 40.0, 30.0, 90.0, 100.0)])
    (after,) = odometry._frames.state.database.all
    assert np.count_nonzero(before.depth_m[50:80, 50:80]) > 800
    assert np.count_nonzero(after.depth_m[50:80, 50:80]) < 300


def test_relocalized_camera_maps_no_known_view_again(room, make_walk) -> None:
    odometry, outward = Odometry(REUSE_EARLY), make_walk(60)
    track(odometry, room, outward)
    odometry.process(room.blank())
    found = odometry.process(room.view(outward[2]), may_map=False)
    assert (found.status, found.pose_source) == (TrackingStatus.OK, "relocalized")
    assert found.denied_keyframe in (None, KeyframeKind.REFERENCE)
    assert odometry._is_connected_to_map


@pytest.mark.parametrize(("after", "expected"), [(0, False), (3, False), (2, True)])
def test_keyframes_are_reused_once_there_are_enough(room, after: int, expected: bool) -> None:
    each_frame = KeyframeConfig(min_frames=1, max_frames=1, still_motion=0.0)
    config = OdometryConfig(keyframe_reuse=KeyframeReuseConfig(after=after), keyframes=each_frame)
    odometry = Odometry(config)
    _, keyframes = track(odometry, room, [moved(0.02 * number) for number in range(2)])
    assert len(keyframes) == 2
    assert odometry._frames.can_reuse_keyframes is expected
