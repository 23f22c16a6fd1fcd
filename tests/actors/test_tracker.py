"""The tracker's messages: poses against exact truth, keyframes only when there is room."""

import msgspec
import numpy as np
import pytest

from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import CameraExtrinsics, Tracker, TrackerConfig
from ldo_service.conversions.frames import frame_from_message, frame_to_message
from ldo_service.conversions.poses import (
    correction_to_message,
    keyframe_poses_from_correction,
    pose_from_message,
    pose_to_message,
    relative_pose_to_message,
)
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import RelativePose, T_map_submap
from ldo_service.runtime.actor import FlowStatus
from ldo_service.schemas import (
    Array,
    FrameRgbd,
    GraphCorrection,
    Keyframe,
    KeyframeRefinement,
    LoopClosure,
    OdometryPrior,
    TrackedPose,
)
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import KEYFRAME_NEW
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import OdometryConfig
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.submaps import SubmapConfig


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
        error = se3.inverse(T_true) @ pose_from_message(pose.T_odom_camera)
        assert pose.status == "OK"
        assert np.linalg.norm(error[:3, 3]) < 2e-3
        assert se3.rotation_angle(error) < 1e-3


def test_every_frame_gets_a_pose_that_hangs_on_a_keyframe(tracked, keyframes, frames) -> None:
    assert len(poses_of(tracked)) == len(frames)
    T_odom = {k.keyframe: pose_from_message(k.T_odom_keyframe) for k in keyframes}
    for pose in poses_of(tracked):
        T_odom_camera = T_odom[pose.reference] @ pose_from_message(pose.T_reference_camera)
        np.testing.assert_allclose(T_odom_camera, pose_from_message(pose.T_odom_camera), atol=1e-9)


def test_keyframes_are_chained_by_ascending_ids(keyframes: list[Keyframe]) -> None:
    assert [k.keyframe for k in keyframes] == list(range(len(keyframes)))
    assert keyframes[0].reference is None
    for keyframe in keyframes[1:]:
        assert keyframe.reference in range(keyframe.keyframe)
        information = np.array(keyframe.information).reshape(6, 6)
        assert (np.linalg.eigvalsh(information) > 0).all()


def test_without_room_no_keyframe_is_made_and_tracking_goes_on(frames, keyframes) -> None:
    tracker = Tracker()
    first = handled(tracker, frames[:1])
    assert any(isinstance(out, Keyframe) for out in first)
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    blocked = handled(tracker, frames[1:15])
    assert not any(isinstance(out, Keyframe) for out in blocked)
    assert all(pose.status == "OK" and pose.reference == 0 for pose in poses_of(blocked))
    assert tracker.metrics()["keyframes_without_credit"] > 0
    assert len(keyframes) > 2, "with room there would have been keyframes"


def test_nothing_is_said_before_somebody_can_map_the_first_keyframe(frames) -> None:
    tracker = Tracker()
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    assert handled(tracker, frames[:3]) == []
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 8})
    keyframe, pose = handled(tracker, frames[3:4])
    assert isinstance(keyframe, Keyframe)
    assert keyframe.frame == 3
    np.testing.assert_array_equal(pose_from_message(pose.T_odom_camera), np.eye(4))


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
    new = {k.keyframe: shift @ pose_from_message(k.T_odom_keyframe) for k in made}
    assert handled(corrected, [correction_to_message(0, 7, new)]) == []
    (expected,) = poses_of(handled(plain, frames[20:21]))
    (pose,) = poses_of(handled(corrected, frames[20:21]))
    assert pose.T_odom_camera == expected.T_odom_camera
    assert pose.graph_version == 7
    np.testing.assert_allclose(pose_from_message(pose.T_map_odom), shift, atol=1e-9)


def test_odometry_does_not_jump_when_a_loop_is_closed(frames, tracked) -> None:
    tracker, optimizer = Tracker(), Optimizer()
    poses: list[TrackedPose] = []
    for number, frame in enumerate(frames):
        out = handled(tracker, [frame])
        poses += poses_of(out)
        made = [message for message in out if isinstance(message, Keyframe)]
        said = [c for keyframe in made for c in optimizer.handle(keyframe)]
        if number == 25:
            newest = poses[-1].reference or 0
            said += optimizer.handle(closure_off_by(0.03, newest, poses[-1].stamp_ns, optimizer))
            assert said[-1].accepted_closures == ((0, newest),)
        handled(tracker, said)
    assert [p.T_odom_camera for p in poses] == [p.T_odom_camera for p in poses_of(tracked)]
    step_m = np.diff([p.T_map_odom.translation for p in poses], axis=0)
    jumped = np.flatnonzero(np.linalg.norm(step_m, axis=1) > 1e-3)
    assert list(jumped) == [25], "the map moves under the camera, once"


def closure_off_by(
    distance_m: float, keyframe: int, stamp_ns: int, optimizer: Optimizer
) -> LoopClosure:
    """Between the first keyframe and another, where odometry has it but for a step."""
    *_, correction = optimizer.handle(KeyframeRefinement(stamp_ns=stamp_ns, poses=()))
    T_map = keyframe_poses_from_correction(correction)
    T_0_keyframe = se3.inverse(T_map[0]) @ T_map[keyframe]
    T_0_keyframe[0, 3] += distance_m
    measured = RelativePose(0, keyframe, T_0_keyframe, 1e6 * np.eye(6))
    return LoopClosure(
        stamp_ns=stamp_ns, pose=relative_pose_to_message(measured), overlap=0.5, rmse_m=0.01
    )


def test_an_older_correction_is_ignored(frames) -> None:
    tracker = Tracker()
    handled(tracker, frames[:2])
    handled(tracker, [correction_to_message(0, 5, {0: np.eye(4)})])
    handled(tracker, [correction_to_message(0, 4, {0: se3.exp(np.full(6, 0.5))})])
    (pose,) = poses_of(handled(tracker, frames[2:3]))
    assert pose.graph_version == 5
    np.testing.assert_allclose(pose_from_message(pose.T_map_odom), np.eye(4), atol=1e-12)


def test_a_successor_goes_on_bit_for_bit(frames: list[FrameRgbd]) -> None:
    first, second = Tracker(), Tracker()
    for frame in frames[:25]:
        list(first.handle(frame))
        state = first.snapshot()
    second.restore(state)
    assert bodies(handled(second, frames[25:])) == bodies(handled(first, frames[25:]))


def test_a_camera_that_counts_from_zero_again_keeps_keyframes_apart(frames) -> None:
    first, second = Tracker(), Tracker()
    again = [
        msgspec.structs.replace(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in frames[:20]
    ]
    made = handled(first, [*frames[:20], *again])
    ids = [message.keyframe for message in made if isinstance(message, Keyframe)]
    assert ids == sorted(set(ids))
    second.restore(first.snapshot())
    assert {pose.status for pose in poses_of(handled(second, frames[20:22]))} == {"OK"}


def test_only_new_keyframes_are_new_objects_in_the_state(frames) -> None:
    tracker = Tracker()
    handled(tracker, frames[:10])
    before = tracker.snapshot()
    handled(tracker, frames[10:11])
    after = tracker.snapshot()
    kept = [name for name in before if name.startswith("place_")]
    assert kept
    assert all(before[name] is after[name] for name in kept)
    assert len(encode_state(after["now"])) < 50_000, "what is written at each frame"


def test_a_lost_camera_is_found_in_the_corrected_map(room: Sequence, frames, keyframes) -> None:
    """By a keyframe that was forgotten by all but the places, and moved since."""
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    tracker, successor = Tracker(), Tracker()
    handled(tracker, frames)
    known = tracker._odometry._map._poses
    known.keep_only([max(known)])
    new = {k.keyframe: shift @ pose_from_message(k.T_odom_keyframe) for k in keyframes}
    handled(tracker, [correction_to_message(0, 7, new)])
    successor.restore(tracker.snapshot())
    back, again = (poses_of(handled(t, frames[2:3]))[0] for t in (tracker, successor))
    assert back.status == "OK"
    assert back.reference not in (None, max(new))
    truth = room.truth()
    assert truth is not None
    T_map_camera = pose_from_message(back.T_map_odom) @ pose_from_message(back.T_odom_camera)
    T_true = shift @ se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[2]
    np.testing.assert_allclose(T_map_camera, T_true, atol=5e-3)
    assert back == msgspec.structs.replace(again, keyframe=back.keyframe), "one id was skipped"


def test_a_lost_camera_may_make_a_keyframe_from_one_it_had_forgotten(
    frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.tracking.map_frame.RECENT_KEYFRAMES", 1)
    often = KeyframeConfig(min_overlap=1.0, min_frames=1)  # every frame that is OK
    tracker = Tracker(TrackerConfig(odometry=OdometryConfig(keyframes=often)))
    handled(tracker, frames)
    tracked, made = poses_of(outs := handled(tracker, frames[2:3]))[0], outs[0]
    assert isinstance(made, Keyframe)
    assert tracked.pose_source == "relocalized"
    assert made.reference == tracked.reference
    assert made.reference < made.keyframe - 20, "long forgotten"


def test_a_correction_before_any_frame_is_harmless() -> None:
    correction: GraphCorrection = correction_to_message(0, 1, {0: np.eye(4)})
    assert list(Tracker().handle(correction)) == []


# --- submaps -------------------------------------------------------------------------------------
SOON = OdometryConfig(
    submaps=SubmapConfig(begin_after_s=0.06, look_every=3, confirm_after=2, confirm_apart_rad=0.05)
)


@pytest.fixture(scope="session")
def returning(room: Sequence) -> list[FrameRgbd]:
    """Twelve frames, then suddenly far away, and step by step back to the first ones."""
    order = [*range(12), *range(60, 4, -2)]
    return [
        msgspec.structs.replace(frame_to_message(room[index]), frame=k, stamp_ns=k * 33_000_000)
        for k, index in enumerate(order)
    ]


def test_a_lost_camera_begins_a_submap_where_odometry_ended(returning) -> None:
    made = handled(Tracker(TrackerConfig(odometry=SOON)), returning[:20])
    poses = poses_of(made)
    assert [pose.status for pose in poses[12:15]] == ["LOST", "LOST", "OK"]
    begun = poses[14]
    assert (begun.submap, poses[11].submap) == (1, 0)
    assert begun.T_odom_camera == poses[11].T_odom_camera, "odometry never jumps"
    np.testing.assert_allclose(pose_from_message(begun.T_map_odom), T_map_submap(1), atol=1e-12)
    first = next(k for k in made if isinstance(k, Keyframe) and k.submap == 1)
    assert (first.reference, first.keyframe) == (None, begun.reference)


def test_without_room_for_a_first_keyframe_a_camera_stays_lost(returning) -> None:
    tracker = Tracker(TrackerConfig(odometry=SOON))
    handled(tracker, returning[:12])
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    assert {pose.status for pose in poses_of(handled(tracker, returning[12:18]))} == {"LOST"}
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 8})
    assert [pose.status for pose in poses_of(handled(tracker, returning[18:20]))] == ["OK", "OK"]


def test_a_submap_is_joined_by_what_both_see_and_moves_with_the_correction(
    room: Sequence, returning
) -> None:
    tracker = Tracker(TrackerConfig(odometry=SOON))
    made = handled(tracker, returning)
    keyframes = [message for message in made if isinstance(message, Keyframe)]
    (joining,) = (k for k in keyframes if k.submap_measurements)
    (join,) = joining.submap_measurements
    assert joining.submap == 1
    truth = room.truth()
    assert truth is not None
    order = [*range(12), *range(60, 4, -2)]
    T_world = {k.keyframe: truth.T_world_camera[order[k.frame]] for k in keyframes}
    T_true = se3.inverse(T_world[join.reference]) @ T_world[join.keyframe]
    np.testing.assert_allclose(pose_from_message(join.T_reference_keyframe), T_true, atol=5e-3)
    placed = {k: se3.inverse(T_world[0]) @ T for k, T in T_world.items()}
    handled(tracker, [correction_to_message(0, 1, placed, joined={1: 0})])
    (pose,) = poses_of(handled(tracker, returning[-1:]))
    assert pose.submap == 0
    T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
    T_expected = se3.inverse(T_world[0]) @ truth.T_world_camera[order[-1]]
    np.testing.assert_allclose(T_map_camera, T_expected, atol=5e-3)


@pytest.mark.parametrize("split", [14, 30])
def test_a_successor_begins_and_joins_submaps_bit_for_bit(returning, split: int) -> None:
    """From a state taken while LOST, and from one between two looks at the old submap."""
    first, second, third = (Tracker(TrackerConfig(odometry=SOON)) for _ in range(3))
    handled(first, returning[:split])
    state = first.snapshot()
    second.restore(state)
    third.restore({name: decode_state(encode_state(part)) for name, part in state.items()})
    after = handled(second, returning[split:])
    assert bodies(after) == bodies(handled(third, returning[split:]))
    assert any(isinstance(message, Keyframe) and message.submap_measurements for message in after)


# --- the robot's base -----------------------------------------------------------------------------
AHEAD = (0.5, -0.5, 0.5, -0.5)  # optical axes in a base with x forward and z up


def test_a_pose_says_where_the_camera_sits_on_the_robot(frames) -> None:
    mounting = CameraExtrinsics(translation_m=(0.2, 0.0, 0.5), quaternion_wxyz=AHEAD)
    (pose,) = poses_of(handled(Tracker(TrackerConfig(T_base_camera=mounting)), frames[:1]))
    T_base_camera = pose_from_message(pose.T_base_camera)
    forward, down = [0, 0, 1], [0, 1, 0]
    np.testing.assert_allclose(T_base_camera[:3, :3] @ forward, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(T_base_camera[:3, :3] @ down, [0, 0, -1], atol=1e-12)
    T_odom_base = pose_from_message(pose.T_odom_camera) @ se3.inverse(T_base_camera)
    camera_in_base = se3.transform(se3.inverse(T_odom_base), np.zeros((1, 3)))  # first: odom
    np.testing.assert_allclose(camera_in_base, [[0.2, 0.0, 0.5]], atol=1e-12)


def test_without_a_mounting_the_base_is_the_camera_and_poses_are_as_ever(frames, tracked) -> None:
    assert all(pose.T_base_camera == IDENTITY for pose in poses_of(tracked))
    mounted = Tracker(TrackerConfig(T_base_camera=CameraExtrinsics(quaternion_wxyz=AHEAD)))
    for pose, other in zip(poses_of(tracked), poses_of(handled(mounted, frames[:5])), strict=False):
        assert pose == msgspec.structs.replace(other, T_base_camera=IDENTITY)


def test_a_quaternion_of_four_digits_is_normalized() -> None:
    mounting = CameraExtrinsics(quaternion_wxyz=(0.7071, 0.0, 0.7071, 0.0))
    np.testing.assert_allclose(np.linalg.det(mounting.matrix()), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    "fields",
    [
        {"quaternion_wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"quaternion_wxyz": (1.0, 1.0, 0.0, 0.0)},
        {"quaternion_wxyz": (float("nan"), 0.0, 0.0, 1.0)},
        {"translation_m": (0.0, float("inf"), 0.0)},
    ],
)
def test_an_impossible_mounting_is_refused(fields) -> None:
    with pytest.raises(ConfigError, match="T_base_camera"):
        CameraExtrinsics(**fields)


# --- another odometry -----------------------------------------------------------------------------
T_BASE_CAMERA = CameraExtrinsics(translation_m=(0.2, 0.0, 0.5), quaternion_wxyz=AHEAD)
T_PRIOR_WORLD = se3.exp(np.array([0.2, 1.0, -0.3, 4.0, -1.0, 2.0]))


@pytest.fixture(scope="session")
def helped(room: Sequence, frames) -> list[FrameRgbd | OdometryPrior]:
    """A fast camera, ten frames of it covered, and between frames where a base has it mounted."""
    truth = room.truth()
    assert truth is not None
    T_camera_base = se3.inverse(T_BASE_CAMERA.matrix())
    messages: list[FrameRgbd | OdometryPrior] = []
    for frame in frames[::2]:
        T_base = T_PRIOR_WORLD @ truth.T_world_camera[frame.frame] @ T_camera_base
        messages.append(
            OdometryPrior(stamp_ns=frame.stamp_ns, T_prior_base=pose_to_message(T_base))
        )
        is_covered = 10 <= frame.frame < 20
        messages.append(without_anything(frame) if is_covered else frame)
    return messages


def without_anything(message: FrameRgbd) -> FrameRgbd:
    color = np.zeros_like(message.color.numpy())
    return msgspec.structs.replace(without_depth(message), color=Array.of(color))


def test_a_prior_says_nothing_by_itself_and_is_read_at_each_frame(helped) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    for message in helped:
        made = list(tracker.handle(message))
        assert bool(made) == isinstance(message, FrameRgbd)
    facts = tracker.metrics()
    assert (facts["frames_with_prior"], facts["frames_without_prior"]) == (20, 0)
    assert (facts["prior_rejected"], facts["prior_restarts"]) == (0, 0)


def test_a_covered_frame_is_never_ok_by_a_prior(helped) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    poses = poses_of(handled(tracker, helped))
    assert [pose.status for pose in poses] == ["OK"] * 5 + ["LOST"] * 5 + ["OK"] * 10


@pytest.mark.parametrize("split", [11, 16])
def test_a_successor_goes_on_with_the_same_prior_bit_for_bit(helped, split: int) -> None:
    """From a state taken behind a pose of the prior, and from one while the camera is covered."""
    first, second, third = (Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA)) for _ in range(3))
    handled(first, helped[:split])
    state = first.snapshot()
    second.restore(state)
    third.restore({name: decode_state(encode_state(part)) for name, part in state.items()})
    after = handled(second, helped[split:])
    assert bodies(after) == bodies(handled(third, helped[split:]))
    assert any(pose.status == "OK" for pose in poses_of(after))


def test_a_pose_of_a_prior_writes_little(helped) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    handled(tracker, helped[:40])
    before = tracker.snapshot()
    last = helped[-2]
    handled(tracker, [msgspec.structs.replace(last, stamp_ns=last.stamp_ns + 10_000_000)])
    after = tracker.snapshot()
    assert [name for name in after if after[name] is not before[name]] == ["prior"]
    assert len(encode_state(after["prior"])) < 15_000


def test_poses_that_cannot_be_used_are_counted_and_the_first_is_said(helped, caplog) -> None:
    tracker = Tracker()
    prior = [message for message in helped if isinstance(message, OdometryPrior)]
    handled(tracker, [*prior[:5], *prior[:5]])
    jump = pose_to_message(se3.exp(np.array([0.0, 0.0, 0.0, 900.0, 0.0, 0.0])))
    handled(tracker, [msgspec.structs.replace(prior[6], T_prior_base=jump), prior[7]])
    facts = tracker.metrics()
    assert (facts["prior_rejected"], facts["prior_restarts"]) == (5, 2)
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 2
    assert f"stamp {prior[0].stamp_ns} has a stamp that is not after the last one's" in warnings[0]
    assert "has jumped" in warnings[1]


def test_a_prior_of_another_clock_changes_nothing_and_is_said_once(frames, helped, caplog) -> None:
    tracker = Tracker()
    stale = msgspec.structs.replace(helped[0], stamp_ns=0)
    later = [msgspec.structs.replace(f, stamp_ns=f.stamp_ns + 10**12) for f in frames]
    expected = handled(Tracker(), later)
    assert bodies(handled(tracker, [stale, *later])) == bodies(expected)
    assert tracker.metrics()["frames_without_prior"] == len(frames)
    (warning,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert "do both stamp by one clock?" in warning


# --- frames that are not what they should be ------------------------------------------------------
def halved(message: FrameRgbd) -> FrameRgbd:
    """Every second pixel: what a camera sends that was switched to half its resolution."""
    frame, k = frame_from_message(message), frame_from_message(message).camera
    camera = Camera(k.width // 2, k.height // 2, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    color, depth_m = (np.ascontiguousarray(a[::2, ::2]) for a in (frame.color, frame.depth_m))
    return frame_to_message(RgbdFrame(color, depth_m, camera, frame.stamp_ns, frame.index))


def cropped(message: FrameRgbd) -> FrameRgbd:
    """The middle of the image: what another lens sees."""
    frame, k = frame_from_message(message), frame_from_message(message).camera
    camera = Camera(k.width - 80, k.height - 60, k.fx, k.fy, k.cx - 40, k.cy - 30)
    color, depth_m = (np.ascontiguousarray(a[30:-30, 40:-40]) for a in (frame.color, frame.depth_m))
    return frame_to_message(RgbdFrame(color, depth_m, camera, frame.stamp_ns, frame.index))


@pytest.mark.parametrize("other_camera", [halved, cropped])
def test_another_camera_mid_stream_is_tracked_against_the_same_surface(
    room: Sequence, frames, other_camera
) -> None:
    """Alignment is of surface points, whichever camera saw them."""
    truth = room.truth()
    assert truth is not None
    tracker = Tracker()
    mixed = [*frames[:10], *(other_camera(f) for f in frames[10:20]), *frames[20:30]]
    poses = poses_of(handled(tracker, mixed))
    T_odom_world = se3.inverse(truth.T_world_camera[0])
    assert [pose.status for pose in poses] == ["OK"] * 30
    for pose in poses:
        T_true = T_odom_world @ truth.T_world_camera[pose.frame]
        error = se3.inverse(T_true) @ pose_from_message(pose.T_odom_camera)
        assert np.linalg.norm(error[:3, 3]) < 5e-3


def without_depth(message: FrameRgbd) -> FrameRgbd:
    nothing = np.zeros_like(message.depth_m.numpy())
    return msgspec.structs.replace(message, depth_m=Array.of(nothing))


def test_frames_without_any_depth_are_not_trusted_and_tracking_recovers(frames) -> None:
    tracker = Tracker()
    blind = [without_depth(frame) for frame in frames[10:16]]
    poses = poses_of(handled(tracker, [*frames[:10], *blind, *frames[16:22]]))
    assert all(pose.status == "OK" for pose in (*poses[:10], *poses[16:]))
    assert all(pose.status in ("WEAK", "LOST") for pose in poses[10:16])
    assert not any(pose.keyframe is not None for pose in poses[10:16])


def test_a_stream_that_begins_without_depth_begins_where_depth_comes(frames) -> None:
    tracker = Tracker()
    made = handled(tracker, [*(without_depth(frame) for frame in frames[:3]), *frames[3:5]])
    assert [pose.status for pose in poses_of(made)][-2:] == ["OK", "OK"]
    (keyframe,) = (message for message in made if isinstance(message, Keyframe))
    assert keyframe.frame == 3


def test_the_smallest_frames_that_come_through_break_nothing(frames) -> None:
    for size in (32, 33, 40):
        camera = Camera(size, size, 30.0, 30.0, size / 2, size / 2)
        color = np.random.default_rng(0).integers(0, 255, (size, size, 3)).astype(np.uint8)
        depth_m = np.ones((size, size), np.float32)
        tiny = frame_to_message(RgbdFrame(color, depth_m, camera, 1, 1))
        assert len(poses_of(handled(Tracker(), [tiny, tiny]))) == 2
        assert len(poses_of(handled(Tracker(), [*frames[:2], tiny, frames[2]]))) == 4
