"""Poses and keyframes that the tracker publishes, compared with exact ground truth."""

import msgspec
import numpy as np
import pytest

from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import CameraExtrinsics, Tracker, TrackerConfig
from ldo_service.conversions.frames import (
    frame_from_message,
    frame_to_message,
    keyframe_measurements_message,
)
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
    KeyframeMeasurements,
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
from tests.actors.conftest import handle_all


def poses_of(messages) -> list[TrackedPose]:
    return [message for message in messages if isinstance(message, TrackedPose)]


def bodies(messages) -> list[bytes]:
    return [msgspec.msgpack.encode(message) for message in messages]


def test_poses_match_ground_truth(room: Sequence, tracked) -> None:
    truth = room.truth()
    assert truth is not None
    T_odom_world = se3.inverse(truth.T_world_camera[0])
    for pose in poses_of(tracked):
        T_true = T_odom_world @ truth.T_world_camera[pose.frame]
        error = se3.inverse(T_true) @ pose_from_message(pose.T_odom_camera)
        assert pose.status == "OK"
        assert np.linalg.norm(error[:3, 3]) < 2e-3
        assert se3.rotation_angle(error) < 1e-3


def test_every_frame_has_a_pose_relative_to_a_keyframe(tracked, keyframes, frames) -> None:
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


def test_without_credits_no_keyframe_is_made_and_tracking_continues(frames, keyframes) -> None:
    tracker = Tracker()
    first = handle_all(tracker, frames[:1])
    assert any(isinstance(out, Keyframe) for out in first)
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    blocked = handle_all(tracker, frames[1:15])
    assert not any(isinstance(out, Keyframe) for out in blocked)
    assert all(pose.status == "OK" and pose.reference == 0 for pose in poses_of(blocked))
    assert tracker.metrics()["keyframes_without_credit"] > 0
    assert len(keyframes) > 2, "with credits there would have been keyframes"


def test_nothing_is_published_before_the_first_keyframe_has_a_credit(frames) -> None:
    tracker = Tracker()
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    assert handle_all(tracker, frames[:3]) == []
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 8})
    keyframe, measurements, pose = handle_all(tracker, frames[3:4])
    assert isinstance(keyframe, Keyframe)
    assert measurements == keyframe_measurements_message(keyframe)
    assert keyframe.frame == 3
    np.testing.assert_array_equal(pose_from_message(pose.T_odom_camera), np.eye(4))


def test_held_out_frames_never_become_keyframes(frames) -> None:
    config = TrackerConfig(hold_out=2)
    made = [k.frame for k in handle_all(Tracker(config), frames) if isinstance(k, Keyframe)]
    assert made
    assert all(frame % 2 == 0 for frame in made)


def test_a_correction_moves_the_map_and_not_the_odometry(frames, keyframes) -> None:
    plain, corrected = Tracker(), Tracker()
    handle_all(plain, frames[:20])
    handle_all(corrected, frames[:20])
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    made = [k for k in keyframes if k.frame < 20]
    new = {k.keyframe: shift @ pose_from_message(k.T_odom_keyframe) for k in made}
    assert handle_all(corrected, [correction_to_message(0, 7, new)]) == []
    (expected,) = poses_of(handle_all(plain, frames[20:21]))
    (pose,) = poses_of(handle_all(corrected, frames[20:21]))
    assert pose.T_odom_camera == expected.T_odom_camera
    assert pose.graph_version == 7
    np.testing.assert_allclose(pose_from_message(pose.T_map_odom), shift, atol=1e-9)


def test_odometry_does_not_jump_when_a_loop_is_closed(frames, tracked) -> None:
    tracker, optimizer = Tracker(), Optimizer()
    poses: list[TrackedPose] = []
    for number, frame in enumerate(frames):
        out = handle_all(tracker, [frame])
        poses += poses_of(out)
        made = [message for message in out if isinstance(message, KeyframeMeasurements)]
        corrections = [c for keyframe in made for c in optimizer.handle(keyframe)]
        if number == 25:
            newest = poses[-1].reference or 0
            corrections += optimizer.handle(
                closure_off_by(0.03, newest, poses[-1].stamp_ns, optimizer)
            )
            assert corrections[-1].accepted_closures == ((0, newest),)
        handle_all(tracker, corrections)
    assert [p.T_odom_camera for p in poses] == [p.T_odom_camera for p in poses_of(tracked)]
    step_m = np.diff([p.T_map_odom.translation for p in poses], axis=0)
    jumped = np.flatnonzero(np.linalg.norm(step_m, axis=1) > 1e-3)
    assert list(jumped) == [25], "the map moves under the camera, once"


def closure_off_by(
    distance_m: float, keyframe: int, stamp_ns: int, optimizer: Optimizer
) -> LoopClosure:
    """Return a closure between the first keyframe and another, off by a distance along x."""
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
    handle_all(tracker, frames[:2])
    handle_all(tracker, [correction_to_message(0, 5, {0: np.eye(4)})])
    handle_all(tracker, [correction_to_message(0, 4, {0: se3.exp(np.full(6, 0.5))})])
    (pose,) = poses_of(handle_all(tracker, frames[2:3]))
    assert pose.graph_version == 5
    np.testing.assert_allclose(pose_from_message(pose.T_map_odom), np.eye(4), atol=1e-12)


def test_restored_tracker_continues_bitwise_equal(frames: list[FrameRgbd]) -> None:
    first, second = Tracker(), Tracker()
    for frame in frames[:25]:
        list(first.handle(frame))
        state = first.snapshot()
    second.restore(state)
    assert bodies(handle_all(second, frames[25:])) == bodies(handle_all(first, frames[25:]))


def test_restarted_frame_numbers_give_unique_keyframe_ids(frames) -> None:
    first, second = Tracker(), Tracker()
    again = [
        msgspec.structs.replace(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in frames[:20]
    ]
    made = handle_all(first, [*frames[:20], *again])
    ids = [message.keyframe for message in made if isinstance(message, Keyframe)]
    assert ids == sorted(set(ids))
    second.restore(first.snapshot())
    assert {pose.status for pose in poses_of(handle_all(second, frames[20:22]))} == {"OK"}


def test_snapshot_shares_the_records_of_old_keyframes(frames) -> None:
    tracker = Tracker()
    handle_all(tracker, frames[:10])
    before = tracker.snapshot()
    handle_all(tracker, frames[10:11])
    after = tracker.snapshot()
    kept = [name for name in before if name.startswith("place_")]
    assert kept
    assert all(before[name] is after[name] for name in kept)
    assert len(encode_state(after["now"])) < 50_000, "the part that is written at each frame"


def test_lost_camera_is_relocalized_in_the_corrected_map(room: Sequence, frames, keyframes) -> None:
    """The keyframe remains only in the keyframe database, and a correction has moved it."""
    shift = se3.exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    tracker, restored = Tracker(), Tracker()
    handle_all(tracker, frames)
    known = tracker._odometry._map._poses
    known.keep_only([max(known)])
    new = {k.keyframe: shift @ pose_from_message(k.T_odom_keyframe) for k in keyframes}
    handle_all(tracker, [correction_to_message(0, 7, new)])
    restored.restore(tracker.snapshot())
    pose, other = (poses_of(handle_all(t, frames[2:3]))[0] for t in (tracker, restored))
    assert pose.status == "OK"
    assert pose.reference not in (None, max(new))
    truth = room.truth()
    assert truth is not None
    T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
    T_true = shift @ se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[2]
    np.testing.assert_allclose(T_map_camera, T_true, atol=5e-3)
    assert pose == msgspec.structs.replace(other, keyframe=pose.keyframe), "one id was skipped"


def test_keyframe_after_relocalization_may_reference_a_forgotten_keyframe(
    frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ldo_service.tracking.map_frame.RECENT_KEYFRAMES", 1)
    every_frame = KeyframeConfig(min_overlap=1.0, min_frames=1)  # Every frame that is OK.
    tracker = Tracker(TrackerConfig(odometry=OdometryConfig(keyframes=every_frame)))
    handle_all(tracker, frames)
    tracked, made = poses_of(outs := handle_all(tracker, frames[2:3]))[0], outs[0]
    assert isinstance(made, Keyframe)
    assert tracked.pose_source == "relocalized"
    assert made.reference == tracked.reference
    assert made.reference < made.keyframe - 20, "long forgotten"


def test_a_correction_before_any_frame_is_harmless() -> None:
    correction: GraphCorrection = correction_to_message(0, 1, {0: np.eye(4)})
    assert list(Tracker().handle(correction)) == []


# --- submaps -------------------------------------------------------------------------------------
QUICK_SUBMAPS = OdometryConfig(
    submaps=SubmapConfig(
        begin_after_frames=9, search_interval_frames=3, confirm_after=2, confirm_apart_rad=0.05
    )
)


@pytest.fixture(scope="session")
def frames_away_and_back(room: Sequence) -> list[FrameRgbd]:
    """Twelve frames, a sudden jump far away, and the way back to the first ones."""
    order = [*range(12), *range(60, 4, -2)]
    return [
        msgspec.structs.replace(frame_to_message(room[index]), frame=k, stamp_ns=k * 33_000_000)
        for k, index in enumerate(order)
    ]


def test_lost_camera_starts_a_submap_at_the_last_odometry_pose(frames_away_and_back) -> None:
    made = handle_all(Tracker(TrackerConfig(odometry=QUICK_SUBMAPS)), frames_away_and_back[:20])
    poses = poses_of(made)
    assert [pose.status for pose in poses[12:15]] == ["LOST", "LOST", "OK"]
    started = poses[14]
    assert (started.submap, poses[11].submap) == (1, 0)
    assert started.T_odom_camera == poses[11].T_odom_camera, "odometry never jumps"
    np.testing.assert_allclose(pose_from_message(started.T_map_odom), T_map_submap(1), atol=1e-12)
    first = next(k for k in made if isinstance(k, Keyframe) and k.submap == 1)
    assert (first.reference, first.keyframe) == (None, started.reference)


def test_without_credits_no_submap_starts_and_the_camera_stays_lost(frames_away_and_back) -> None:
    tracker = Tracker(TrackerConfig(odometry=QUICK_SUBMAPS))
    handle_all(tracker, frames_away_and_back[:12])
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 0})
    blocked = handle_all(tracker, frames_away_and_back[12:18])
    assert {pose.status for pose in poses_of(blocked)} == {"LOST"}
    tracker.situation = FlowStatus(credits={KEYFRAME_NEW: 8})
    allowed = handle_all(tracker, frames_away_and_back[18:20])
    assert [pose.status for pose in poses_of(allowed)] == ["OK", "OK"]


def test_submap_is_measured_at_a_shared_view_and_merged_by_the_correction(
    room: Sequence, frames_away_and_back
) -> None:
    tracker = Tracker(TrackerConfig(odometry=QUICK_SUBMAPS))
    made = handle_all(tracker, frames_away_and_back)
    keyframes = [message for message in made if isinstance(message, Keyframe)]
    (merging,) = (k for k in keyframes if k.submap_measurements)
    (measured,) = merging.submap_measurements
    assert merging.submap == 1
    truth = room.truth()
    assert truth is not None
    order = [*range(12), *range(60, 4, -2)]
    T_world = {k.keyframe: truth.T_world_camera[order[k.frame]] for k in keyframes}
    T_true = se3.inverse(T_world[measured.reference]) @ T_world[measured.keyframe]
    np.testing.assert_allclose(pose_from_message(measured.T_reference_keyframe), T_true, atol=5e-3)
    placed = {k: se3.inverse(T_world[0]) @ T for k, T in T_world.items()}
    handle_all(tracker, [correction_to_message(0, 1, placed, merged={1: 0})])
    (pose,) = poses_of(handle_all(tracker, frames_away_and_back[-1:]))
    assert pose.submap == 0
    T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
    T_expected = se3.inverse(T_world[0]) @ truth.T_world_camera[order[-1]]
    np.testing.assert_allclose(T_map_camera, T_expected, atol=5e-3)


@pytest.mark.parametrize("split", [14, 30])
def test_restored_tracker_starts_and_merges_submaps_bitwise_equal(
    frames_away_and_back, split: int
) -> None:
    """Restored while LOST, and between two observations of the old submap."""
    first, second, third = (Tracker(TrackerConfig(odometry=QUICK_SUBMAPS)) for _ in range(3))
    handle_all(first, frames_away_and_back[:split])
    state = first.snapshot()
    second.restore(state)
    third.restore({name: decode_state(encode_state(part)) for name, part in state.items()})
    after = handle_all(second, frames_away_and_back[split:])
    assert bodies(after) == bodies(handle_all(third, frames_away_and_back[split:]))
    assert any(isinstance(message, Keyframe) and message.submap_measurements for message in after)


# --- camera extrinsics ----------------------------------------------------------------------------
AHEAD = (0.5, -0.5, 0.5, -0.5)  # Optical axes in a base with x forward and z up.


def test_pose_includes_the_camera_extrinsics(frames) -> None:
    mounting = CameraExtrinsics(translation_m=(0.2, 0.0, 0.5), quaternion_wxyz=AHEAD)
    (pose,) = poses_of(handle_all(Tracker(TrackerConfig(T_base_camera=mounting)), frames[:1]))
    T_base_camera = pose_from_message(pose.T_base_camera)
    forward, down = [0, 0, 1], [0, 1, 0]
    np.testing.assert_allclose(T_base_camera[:3, :3] @ forward, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(T_base_camera[:3, :3] @ down, [0, 0, -1], atol=1e-12)
    T_odom_base = pose_from_message(pose.T_odom_camera) @ se3.inverse(T_base_camera)
    # The first camera frame is odom.
    camera_in_base = se3.transform(se3.inverse(T_odom_base), np.zeros((1, 3)))
    np.testing.assert_allclose(camera_in_base, [[0.2, 0.0, 0.5]], atol=1e-12)


def test_default_extrinsics_are_identity_and_change_no_other_field(frames, tracked) -> None:
    assert all(pose.T_base_camera == IDENTITY for pose in poses_of(tracked))
    mounted = Tracker(TrackerConfig(T_base_camera=CameraExtrinsics(quaternion_wxyz=AHEAD)))
    poses_mounted = poses_of(handle_all(mounted, frames[:5]))
    for pose, other in zip(poses_of(tracked), poses_mounted, strict=False):
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
def test_invalid_extrinsics_are_refused(fields) -> None:
    with pytest.raises(ConfigError, match="T_base_camera"):
        CameraExtrinsics(**fields)


# --- odometry prior -------------------------------------------------------------------------------
T_BASE_CAMERA = CameraExtrinsics(translation_m=(0.2, 0.0, 0.5), quaternion_wxyz=AHEAD)
T_PRIOR_WORLD = se3.exp(np.array([0.2, 1.0, -0.3, 4.0, -1.0, 2.0]))


@pytest.fixture(scope="session")
def frames_with_prior(room: Sequence, frames) -> list[FrameRgbd | OdometryPrior]:
    """Frames of a fast camera, some of them covered; a prior pose precedes each frame."""
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
        messages.append(covered(frame) if is_covered else frame)
    return messages


def covered(message: FrameRgbd) -> FrameRgbd:
    color = np.zeros_like(message.color.numpy())
    return msgspec.structs.replace(without_depth(message), color=Array.of(color))


def test_prior_gives_no_output_and_is_used_with_each_frame(frames_with_prior) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    for message in frames_with_prior:
        made = list(tracker.handle(message))
        assert bool(made) == isinstance(message, FrameRgbd)
    metrics = tracker.metrics()
    assert (metrics["frames_with_prior"], metrics["frames_without_prior"]) == (20, 0)
    assert (metrics["prior_rejected"], metrics["prior_restarts"]) == (0, 0)


def test_covered_frame_with_prior_is_never_ok(frames_with_prior) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    poses = poses_of(handle_all(tracker, frames_with_prior))
    assert [pose.status for pose in poses] == ["OK"] * 5 + ["LOST"] * 5 + ["OK"] * 10


@pytest.mark.parametrize("split", [11, 16])
def test_restored_tracker_with_prior_continues_bitwise_equal(frames_with_prior, split: int) -> None:
    """Restored after a prior pose, and while the camera is covered."""
    first, second, third = (Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA)) for _ in range(3))
    handle_all(first, frames_with_prior[:split])
    state = first.snapshot()
    second.restore(state)
    third.restore({name: decode_state(encode_state(part)) for name, part in state.items()})
    after = handle_all(second, frames_with_prior[split:])
    assert bodies(after) == bodies(handle_all(third, frames_with_prior[split:]))
    assert any(pose.status == "OK" for pose in poses_of(after))


def test_prior_pose_changes_one_small_part_of_the_snapshot(frames_with_prior) -> None:
    tracker = Tracker(TrackerConfig(T_base_camera=T_BASE_CAMERA))
    handle_all(tracker, frames_with_prior[:40])
    before = tracker.snapshot()
    last = frames_with_prior[-2]
    handle_all(tracker, [msgspec.structs.replace(last, stamp_ns=last.stamp_ns + 10_000_000)])
    after = tracker.snapshot()
    assert [name for name in after if after[name] is not before[name]] == ["prior"]
    assert len(encode_state(after["prior"])) < 15_000


def test_unusable_prior_poses_are_counted_and_logged_once_per_kind(
    frames_with_prior, caplog
) -> None:
    tracker = Tracker()
    prior = [message for message in frames_with_prior if isinstance(message, OdometryPrior)]
    handle_all(tracker, [*prior[:5], *prior[:5]])
    jump = pose_to_message(se3.exp(np.array([0.0, 0.0, 0.0, 900.0, 0.0, 0.0])))
    handle_all(tracker, [msgspec.structs.replace(prior[6], T_prior_base=jump), prior[7]])
    metrics = tracker.metrics()
    assert (metrics["prior_rejected"], metrics["prior_restarts"]) == (5, 2)
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 2
    assert f"stamp {prior[0].stamp_ns} ns is not later than the previous pose" in warnings[0]
    assert "has jumped" in warnings[1]


def test_prior_of_another_clock_is_ignored_and_logged_once(
    frames, frames_with_prior, caplog
) -> None:
    tracker = Tracker()
    stale = msgspec.structs.replace(frames_with_prior[0], stamp_ns=0)
    later = [msgspec.structs.replace(f, stamp_ns=f.stamp_ns + 10**12) for f in frames]
    expected = handle_all(Tracker(), later)
    assert bodies(handle_all(tracker, [stale, *later])) == bodies(expected)
    assert tracker.metrics()["frames_without_prior"] == len(frames)
    (warning,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert "use one clock" in warning


# --- unusual frames -------------------------------------------------------------------------------
def halved(message: FrameRgbd) -> FrameRgbd:
    """Return every second pixel, as from a camera at half its resolution."""
    frame, k = frame_from_message(message), frame_from_message(message).camera
    camera = Camera(k.width // 2, k.height // 2, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    color, depth_m = (np.ascontiguousarray(a[::2, ::2]) for a in (frame.color, frame.depth_m))
    return frame_to_message(RgbdFrame(color, depth_m, camera, frame.stamp_ns, frame.index))


def cropped(message: FrameRgbd) -> FrameRgbd:
    """Return the middle of the image, as from a lens with a narrower view."""
    frame, k = frame_from_message(message), frame_from_message(message).camera
    camera = Camera(k.width - 80, k.height - 60, k.fx, k.fy, k.cx - 40, k.cy - 30)
    color, depth_m = (np.ascontiguousarray(a[30:-30, 40:-40]) for a in (frame.color, frame.depth_m))
    return frame_to_message(RgbdFrame(color, depth_m, camera, frame.stamp_ns, frame.index))


@pytest.mark.parametrize("other_camera", [halved, cropped])
def test_camera_change_mid_stream_keeps_tracking(room: Sequence, frames, other_camera) -> None:
    """Alignment uses surface points, independent of the camera that observed them."""
    truth = room.truth()
    assert truth is not None
    tracker = Tracker()
    mixed = [*frames[:10], *(other_camera(f) for f in frames[10:20]), *frames[20:30]]
    poses = poses_of(handle_all(tracker, mixed))
    T_odom_world = se3.inverse(truth.T_world_camera[0])
    assert [pose.status for pose in poses] == ["OK"] * 30
    for pose in poses:
        T_true = T_odom_world @ truth.T_world_camera[pose.frame]
        error = se3.inverse(T_true) @ pose_from_message(pose.T_odom_camera)
        assert np.linalg.norm(error[:3, 3]) < 5e-3


def without_depth(message: FrameRgbd) -> FrameRgbd:
    no_depth = np.zeros_like(message.depth_m.numpy())
    return msgspec.structs.replace(message, depth_m=Array.of(no_depth))


def test_frames_without_depth_are_not_ok_and_tracking_recovers(frames) -> None:
    tracker = Tracker()
    blind = [without_depth(frame) for frame in frames[10:16]]
    poses = poses_of(handle_all(tracker, [*frames[:10], *blind, *frames[16:22]]))
    assert all(pose.status == "OK" for pose in (*poses[:10], *poses[16:]))
    assert all(pose.status in ("WEAK", "LOST") for pose in poses[10:16])
    assert not any(pose.keyframe is not None for pose in poses[10:16])


def test_first_keyframe_is_the_first_frame_with_depth(frames) -> None:
    tracker = Tracker()
    made = handle_all(tracker, [*(without_depth(frame) for frame in frames[:3]), *frames[3:5]])
    assert [pose.status for pose in poses_of(made)][-2:] == ["OK", "OK"]
    (keyframe,) = (message for message in made if isinstance(message, Keyframe))
    assert keyframe.frame == 3


def test_smallest_accepted_frames_are_tracked_without_error(frames) -> None:
    for size in (32, 33, 40):
        camera = Camera(size, size, 30.0, 30.0, size / 2, size / 2)
        color = np.random.default_rng(0).integers(0, 255, (size, size, 3)).astype(np.uint8)
        depth_m = np.ones((size, size), np.float32)
        tiny = frame_to_message(RgbdFrame(color, depth_m, camera, 1, 1))
        assert len(poses_of(handle_all(Tracker(), [tiny, tiny]))) == 2
        assert len(poses_of(handle_all(Tracker(), [*frames[:2], tiny, frames[2]]))) == 4
