"""Keyframe reuse by a camera that returns: few new keyframes, exact poses, no odometry jump."""

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
from ldo_service.tracking.keyframe_reuse import KeyframeReuseConfig


def config_with_reuse(after: int) -> TrackerConfig:
    return TrackerConfig(odometry=OdometryConfig(keyframe_reuse=KeyframeReuseConfig(after=after)))


@pytest.fixture(scope="module")
def return_frames(frames: list[FrameRgbd]) -> list[FrameRgbd]:
    """The frames in reverse order, with consecutive numbers and stamps."""
    period_ns = frames[1].stamp_ns - frames[0].stamp_ns
    return [
        msgspec.structs.replace(
            frame, frame=len(frames) + k, stamp_ns=frames[-1].stamp_ns + (k + 1) * period_ns
        )
        for k, frame in enumerate(reversed(frames[:-1]))
    ]


RoundTrip = tuple[Tracker, list[TrackedPose], list[Keyframe]]


def round_trip(
    after: int,
    frames: Many[FrameRgbd],
    return_frames: Many[FrameRgbd],
    distortion: np.ndarray | None = None,
    restarts: bool = False,
    forgets_at: int | None = None,
) -> RoundTrip:
    """Track the frames and then the way back, in a map of the outward keyframes.

    Args:
        after: Keyframes before reuse starts; 0 for never.
        frames: Frames of the outward way.
        return_frames: Frames of the way back.
        distortion: Motion [4, 4] of the first half of the keyframes in the map.
        restarts: True to restore a new tracker after every fifth frame.
        forgets_at: Frame at which a correction keeps the newest keyframe only.

    Returns:
        The tracker, and the poses and keyframes of the way back.
    """
    tracker = Tracker(config_with_reuse(after))
    outward = [out for frame in frames for out in tracker.handle(frame)]
    T_map = {
        k.keyframe: pose_from_message(k.T_odom_keyframe) for k in outward if isinstance(k, Keyframe)
    }
    for keyframe in list(T_map)[: len(T_map) // 2] if distortion is not None else ():
        T_map[keyframe] = distortion @ T_map[keyframe]
    assert list(tracker.handle(correction_to_message(0, 7, T_map))) == []
    returned = []
    for frame in return_frames:
        if restarts and frame.frame % 5 == 0:
            state, tracker = tracker.snapshot(), Tracker(config_with_reuse(after))
            tracker.restore(decode_state(encode_state(state)))
        returned += tracker.handle(frame)
        if frame.frame == forgets_at:
            newest = max(T_map)
            list(tracker.handle(correction_to_message(0, 8, {newest: T_map[newest]})))
    poses = [out for out in returned if isinstance(out, TrackedPose)]
    return tracker, poses, [out for out in returned if isinstance(out, Keyframe)]


@pytest.fixture(scope="module")
def returned(frames, return_frames) -> RoundTrip:
    """A round trip with reuse; tests must not change its tracker."""
    return round_trip(1, frames, return_frames)


def test_return_makes_a_single_keyframe_measured_against_known_ones(
    room: Sequence, frames, keyframes, return_frames, returned: RoundTrip
) -> None:
    _, _, without_reuse = round_trip(0, frames, return_frames)
    tracker, poses, made = returned
    assert len(without_reuse) > 4
    (connecting,) = made
    assert tracker.metrics()["keyframes_reused"] > 2
    T_odom = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    known = [m for m in connecting.window_measurements if m.reference < (connecting.reference or 0)]
    assert known
    for measured in known:
        T_true = se3.inverse(T_odom[measured.reference]) @ pose_from_message(
            connecting.T_odom_keyframe
        )
        np.testing.assert_allclose(
            pose_from_message(measured.T_reference_keyframe), T_true, atol=3e-3
        )
    references = [pose.reference for pose in poses]
    references_after = references[references.index(connecting.keyframe) + 1 :]
    assert max(references_after) == connecting.keyframe
    assert len(set(references_after)) > 3
    truth = room.truth()
    assert truth is not None
    T_map_world = se3.inverse(truth.T_world_camera[0])
    for pose, index in zip(poses, range(len(frames) - 2, -1, -1), strict=True):
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        error = se3.inverse(T_map_world @ truth.T_world_camera[index]) @ T_map_camera
        assert pose.status == "OK"
        assert np.linalg.norm(error[:3, 3]) < 3e-3
        assert se3.rotation_angle(error) < 2e-3


def test_odometry_does_not_jump_where_the_camera_returns(
    room: Sequence, frames, returned: RoundTrip
) -> None:
    _, poses, _ = returned
    truth = room.truth()
    assert truth is not None
    T_odom = [pose_from_message(pose.T_odom_camera) for pose in poses]
    T_world = [truth.T_world_camera[k] for k in range(len(frames) - 2, -1, -1)]
    for k in range(1, len(poses)):
        step = se3.inverse(T_odom[k - 1]) @ T_odom[k]
        error = se3.inverse(se3.inverse(T_world[k - 1]) @ T_world[k]) @ step
        assert np.linalg.norm(error[:3, 3]) < 2e-3


def test_pose_on_return_is_relative_to_a_corrected_keyframe(
    frames, keyframes, return_frames
) -> None:
    """A later correction then also moves the poses tracked against it."""
    tracker, poses, made = round_trip(1, frames, return_frames[:-2])
    T_odom = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in (*keyframes, *made)}
    assert_relative_to_keyframes(poses, T_odom)
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    T_map = {number: shift @ T for number, T in T_odom.items()}
    assert list(tracker.handle(correction_to_message(0, 8, T_map))) == []
    after = [out for frame in return_frames[-2:] for out in tracker.handle(frame)]
    assert all(isinstance(out, TrackedPose) for out in after)
    assert_relative_to_keyframes(after, T_map)


def assert_relative_to_keyframes(poses: Many[TrackedPose], T_map: dict[int, np.ndarray]) -> None:
    for pose in poses:
        assert pose.reference is not None
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        expected = T_map[pose.reference] @ pose_from_message(pose.T_reference_camera)
        np.testing.assert_allclose(T_map_camera, expected, atol=1e-6)


def test_distorted_map_gets_new_keyframes_for_loop_closure(frames, return_frames) -> None:
    distortion = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    _, _, made = round_trip(1, frames, return_frames, distortion)
    assert made, "without keyframes no loop could be closed"


def test_restarts_give_bitwise_equal_outputs(frames, return_frames) -> None:
    """Measurements of keyframes that are made after reuse outside the map are also equal."""
    forget_frame = return_frames[18].frame
    _, poses, made = round_trip(1, frames, return_frames, forgets_at=forget_frame)
    _, poses_restarted, made_restarted = round_trip(
        1, frames, return_frames, restarts=True, forgets_at=forget_frame
    )
    assert len(made) > 2
    assert made[-1].window_measurements
    encode = msgspec.msgpack.encode
    assert [encode(pose) for pose in poses] == [encode(pose) for pose in poses_restarted]
    assert [encode(keyframe) for keyframe in made] == [
        encode(keyframe) for keyframe in made_restarted
    ]


def test_without_credits_no_keyframe_is_made_or_reused(frames, return_frames) -> None:
    tracker = Tracker(config_with_reuse(1))
    outward = [out for frame in frames for out in tracker.handle(frame)]
    T_map = {
        k.keyframe: pose_from_message(k.T_odom_keyframe) for k in outward if isinstance(k, Keyframe)
    }
    list(tracker.handle(correction_to_message(0, 7, T_map)))
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    poses = [out for frame in return_frames[:12] for out in tracker.handle(frame)]
    assert all(isinstance(pose, TrackedPose) and pose.status == "OK" for pose in poses)
    assert tracker.metrics()["keyframes_reused"] == 0


def test_without_corrections_no_keyframe_is_reused(frames, return_frames) -> None:
    tracker = Tracker(config_with_reuse(1))
    returned = [out for frame in [*frames, *return_frames] for out in tracker.handle(frame)]
    assert tracker.metrics()["keyframes_reused"] == 0
    assert sum(isinstance(out, Keyframe) for out in returned) > 8


def test_stored_poses_stay_bounded_while_no_keyframe_is_made(
    frames, return_frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.tracking.map_frame.RECENT_KEYFRAMES", 2)
    tracker, _, made = round_trip(1, frames, return_frames)
    assert len(made) == 1
    assert len(tracker._odometry._map._poses) <= 4
