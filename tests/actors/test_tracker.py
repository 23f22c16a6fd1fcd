"""The tracker's messages: poses against exact truth, keyframes only when there is room."""

import msgspec
import numpy as np

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.datasets import Sequence
from ldo_service.geometry import se3
from ldo_service.schemas import Correction, FrameRgbd, Keyframe, TrackedPose
from ldo_service.schemas.topics import KEYFRAME_NEW
from ldo_service.wire import correction_message, transform


def poses_of(messages) -> list[TrackedPose]:
    return [message for message in messages if isinstance(message, TrackedPose)]


def handled(tracker: Tracker, messages) -> list:
    return [out for message in messages for out in tracker.handle(message)]


def bodies(messages) -> list[bytes]:
    return [msgspec.msgpack.encode(message) for message in messages]


def test_poses_follow_the_true_camera(room: Sequence, tracked) -> None:
    truth = room.truth()
    assert truth is not None
    T_odom_world = se3.inverse(truth.T_world_camera[0])
    for pose in poses_of(tracked):
        T_true = T_odom_world @ truth.T_world_camera[pose.frame]
        error = se3.inverse(T_true) @ transform(pose.T_odom_camera)
        assert pose.status == "OK"
        assert np.linalg.norm(error[:3, 3]) < 2e-3
        assert se3.rotation_angle(error) < 1e-3


def test_every_frame_gets_a_pose_that_hangs_on_a_keyframe(tracked, keyframes, frames) -> None:
    assert len(poses_of(tracked)) == len(frames)
    T_odom = {k.keyframe: transform(k.T_odom_keyframe) for k in keyframes}
    for pose in poses_of(tracked):
        T_odom_camera = T_odom[pose.reference] @ transform(pose.T_reference_camera)
        np.testing.assert_allclose(T_odom_camera, transform(pose.T_odom_camera), atol=1e-9)


def test_keyframes_are_chained_by_ascending_ids(keyframes: list[Keyframe]) -> None:
    assert [k.keyframe for k in keyframes] == list(range(len(keyframes)))
    assert keyframes[0].reference is None
    for keyframe in keyframes[1:]:
        assert keyframe.reference == keyframe.keyframe - 1
        information = np.array(keyframe.information).reshape(6, 6)
        assert (np.linalg.eigvalsh(information) > 0).all()


def test_without_room_no_keyframe_is_made_and_tracking_goes_on(frames, keyframes) -> None:
    tracker = Tracker()
    first = handled(tracker, frames[:1])
    assert any(isinstance(out, Keyframe) for out in first)
    tracker.room = {KEYFRAME_NEW: 0}
    blocked = handled(tracker, frames[1:15])
    assert not any(isinstance(out, Keyframe) for out in blocked)
    assert all(pose.status == "OK" and pose.reference == 0 for pose in poses_of(blocked))
    assert tracker.facts()["keyframes_without_room"] > 0
    assert len(keyframes) > 2, "with room there would have been keyframes"


def test_nothing_is_said_before_somebody_can_map_the_first_keyframe(frames) -> None:
    tracker = Tracker()
    tracker.room = {KEYFRAME_NEW: 0}
    assert handled(tracker, frames[:3]) == []
    tracker.room = {KEYFRAME_NEW: 8}
    keyframe, pose = handled(tracker, frames[3:4])
    assert isinstance(keyframe, Keyframe)
    assert keyframe.frame == 3
    np.testing.assert_array_equal(transform(pose.T_odom_camera), np.eye(4))


def test_held_out_frames_never_become_keyframes(frames) -> None:
    config = TrackerConfig(hold_out=2)
    made = [k.frame for k in handled(Tracker(config), frames) if isinstance(k, Keyframe)]
    assert made
    assert all(frame % 2 == 0 for frame in made)


def test_a_correction_moves_the_map_and_not_the_odometry(frames, keyframes) -> None:
    plain, corrected = Tracker(), Tracker()
    handled(plain, frames[:20])
    handled(corrected, frames[:20])
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    made = [k for k in keyframes if k.frame < 20]
    new = {k.keyframe: shift @ transform(k.T_odom_keyframe) for k in made}
    assert handled(corrected, [correction_message(0, 7, new)]) == []
    (expected,) = poses_of(handled(plain, frames[20:21]))
    (pose,) = poses_of(handled(corrected, frames[20:21]))
    assert pose.T_odom_camera == expected.T_odom_camera
    assert pose.graph_version == 7
    np.testing.assert_allclose(transform(pose.T_map_odom), shift, atol=1e-9)


def test_an_older_correction_is_ignored(frames) -> None:
    tracker = Tracker()
    handled(tracker, frames[:2])
    handled(tracker, [correction_message(0, 5, {0: np.eye(4)})])
    handled(tracker, [correction_message(0, 4, {0: se3.exp(np.full(6, 0.5))})])
    (pose,) = poses_of(handled(tracker, frames[2:3]))
    assert pose.graph_version == 5
    np.testing.assert_allclose(transform(pose.T_map_odom), np.eye(4), atol=1e-12)


def test_a_successor_goes_on_bit_for_bit(frames: list[FrameRgbd]) -> None:
    first, second = Tracker(), Tracker()
    for frame in frames[:25]:
        list(first.handle(frame))
        state = first.snapshot()
    second.restore(state)
    assert bodies(handled(second, frames[25:])) == bodies(handled(first, frames[25:]))


def test_only_new_keyframes_are_new_objects_in_the_state(frames) -> None:
    tracker = Tracker()
    handled(tracker, frames[:10])
    before = tracker.snapshot()
    handled(tracker, frames[10:11])
    after = tracker.snapshot()
    kept = [name for name in before if name.startswith("keyframe_") and name in after]
    assert kept
    assert all(before[name] is after[name] for name in kept)


def test_a_correction_before_any_frame_is_harmless() -> None:
    correction: Correction = correction_message(0, 1, {0: np.eye(4)})
    assert list(Tracker().handle(correction)) == []
