"""A camera on its round: keyframes are made once, poses stay right, odometry does not jump."""

from collections.abc import Sequence as Many

import msgspec
import numpy as np
import pytest

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.conversions.poses import correction_to_message, pose_from_message
from ldo_service.datasets import Sequence
from ldo_service.geometry import se3
from ldo_service.runtime.actor import FlowStatus
from ldo_service.schemas import FrameRgbd, Keyframe, TrackedPose
from ldo_service.schemas.topics import KEYFRAME_NEW
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import OdometryConfig
from ldo_service.tracking.relocalization import KeyframeReuseConfig


def configured(after: int) -> TrackerConfig:
    return TrackerConfig(odometry=OdometryConfig(returning=KeyframeReuseConfig(after=after)))


@pytest.fixture(scope="module")
def back(frames: list[FrameRgbd]) -> list[FrameRgbd]:
    """The way back, with numbers and stamps that go on."""
    period_ns = frames[1].stamp_ns - frames[0].stamp_ns
    return [
        msgspec.structs.replace(
            frame, frame=len(frames) + k, stamp_ns=frames[-1].stamp_ns + (k + 1) * period_ns
        )
        for k, frame in enumerate(reversed(frames[:-1]))
    ]


def round_trip(
    after: int,
    frames: Many[FrameRgbd],
    back: Many[FrameRgbd],
    bend: np.ndarray | None = None,
    restarts: bool = False,
    forgets_at: int | None = None,
) -> tuple[Tracker, list[TrackedPose], list[Keyframe]]:
    """What is said on the way back, in a map that has the keyframes of the way there; with `bend`
    [4, 4] the first half of them elsewhere; from one frame on it has but the last."""
    tracker = Tracker(configured(after))
    there = [out for frame in frames for out in tracker.handle(frame)]
    T_map = {
        k.keyframe: pose_from_message(k.T_odom_keyframe) for k in there if isinstance(k, Keyframe)
    }
    for keyframe in list(T_map)[: len(T_map) // 2] if bend is not None else ():
        T_map[keyframe] = bend @ T_map[keyframe]
    assert list(tracker.handle(correction_to_message(0, 7, T_map))) == []
    said = []
    for frame in back:
        if restarts:
            state, tracker = tracker.snapshot(), Tracker(configured(after))
            tracker.restore(decode_state(encode_state(state)))
        said += tracker.handle(frame)
        if frame.frame == forgets_at:
            newest = max(T_map)
            list(tracker.handle(correction_to_message(0, 8, {newest: T_map[newest]})))
    poses = [out for out in said if isinstance(out, TrackedPose)]
    return tracker, poses, [out for out in said if isinstance(out, Keyframe)]


def test_on_the_way_back_one_keyframe_ties_the_new_to_the_known_and_no_more_are_made(
    room: Sequence, frames, keyframes, back
) -> None:
    _, _, otherwise = round_trip(0, frames, back)
    tracker, poses, made = round_trip(1, frames, back)
    assert len(otherwise) > 4
    (tie,) = made
    assert tracker.metrics()["keyframes_reused"] > 2
    T_odom = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    known = [m for m in tie.window_measurements if m.reference < (tie.reference or 0)]
    assert known
    for measured in known:
        T_true = se3.inverse(T_odom[measured.reference]) @ pose_from_message(tie.T_odom_keyframe)
        np.testing.assert_allclose(
            pose_from_message(measured.T_reference_keyframe), T_true, atol=3e-3
        )
    references = [pose.reference for pose in poses]
    since = references[references.index(tie.keyframe) + 1 :]
    assert max(since) == tie.keyframe
    assert len(set(since)) > 3
    truth = room.truth()
    assert truth is not None
    T_map_world = se3.inverse(truth.T_world_camera[0])
    for pose, index in zip(poses, range(len(frames) - 2, -1, -1), strict=True):
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        error = se3.inverse(T_map_world @ truth.T_world_camera[index]) @ T_map_camera
        assert pose.status == "OK"
        assert np.linalg.norm(error[:3, 3]) < 3e-3
        assert se3.rotation_angle(error) < 2e-3


def test_odometry_does_not_jump_where_the_camera_returns(room: Sequence, frames, back) -> None:
    _, poses, _ = round_trip(1, frames, back)
    truth = room.truth()
    assert truth is not None
    T_odom = [pose_from_message(pose.T_odom_camera) for pose in poses]
    T_world = [truth.T_world_camera[k] for k in range(len(frames) - 2, -1, -1)]
    for k in range(1, len(poses)):
        step = se3.inverse(T_odom[k - 1]) @ T_odom[k]
        error = se3.inverse(se3.inverse(T_world[k - 1]) @ T_world[k]) @ step
        assert np.linalg.norm(error[:3, 3]) < 2e-3


def test_a_pose_hangs_on_the_keyframe_that_the_map_has(frames, keyframes, back) -> None:
    """So a later correction moves what was tracked with it."""
    tracker, poses, made = round_trip(1, frames, back[:-2])
    T_odom = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in (*keyframes, *made)}
    assert_hang_on_keyframes(poses, T_odom)
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    T_map = {number: shift @ T for number, T in T_odom.items()}
    assert list(tracker.handle(correction_to_message(0, 8, T_map))) == []
    after = [out for frame in back[-2:] for out in tracker.handle(frame)]
    assert all(isinstance(out, TrackedPose) for out in after)
    assert_hang_on_keyframes(after, T_map)


def assert_hang_on_keyframes(poses: Many[TrackedPose], T_map: dict[int, np.ndarray]) -> None:
    for pose in poses:
        assert pose.reference is not None
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        expected = T_map[pose.reference] @ pose_from_message(pose.T_reference_camera)
        np.testing.assert_allclose(T_map_camera, expected, atol=1e-6)


def test_where_the_map_is_bent_keyframes_are_made_so_that_a_loop_can_be_closed(
    frames, back
) -> None:
    bend = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    _, _, made = round_trip(1, frames, back, bend)
    assert made, "nothing would ever mend the map"


def test_a_restart_after_each_frame_changes_nothing(frames, back) -> None:
    """Nor what a keyframe is measured from that is made after returns, where the map has none."""
    then = back[18].frame
    _, poses, made = round_trip(1, frames, back, forgets_at=then)
    _, again, remade = round_trip(1, frames, back, restarts=True, forgets_at=then)
    assert len(made) > 2
    assert made[-1].window_measurements
    encode = msgspec.msgpack.encode
    assert [encode(pose) for pose in poses] == [encode(pose) for pose in again]
    assert [encode(keyframe) for keyframe in made] == [encode(keyframe) for keyframe in remade]


def test_without_room_nobody_is_tied_and_nobody_returns(frames, back) -> None:
    tracker = Tracker(configured(1))
    there = [out for frame in frames for out in tracker.handle(frame)]
    T_map = {
        k.keyframe: pose_from_message(k.T_odom_keyframe) for k in there if isinstance(k, Keyframe)
    }
    list(tracker.handle(correction_to_message(0, 7, T_map)))
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    poses = [out for frame in back[:12] for out in tracker.handle(frame)]
    assert all(isinstance(pose, TrackedPose) and pose.status == "OK" for pose in poses)
    assert tracker.metrics()["keyframes_reused"] == 0


def test_without_a_map_nobody_returns(frames, back) -> None:
    tracker = Tracker(configured(1))
    said = [out for frame in [*frames, *back] for out in tracker.handle(frame)]
    assert tracker.metrics()["keyframes_reused"] == 0
    assert sum(isinstance(out, Keyframe) for out in said) > 8


def test_what_is_remembered_does_not_grow_while_no_keyframe_is_made(
    frames, back, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.tracking.map_frame.RECENT_KEYFRAMES", 2)
    tracker, _, made = round_trip(1, frames, back)
    assert len(made) == 1
    assert len(tracker._odometry._map._poses) <= 4
