"""Corrections of the optimizer from keyframes and their measurements."""

import msgspec
import numpy as np

from ldo_service.actors.optimizer import Optimizer
from ldo_service.conversions.poses import (
    keyframe_poses_from_correction,
    pose_from_message,
    pose_to_message,
)
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import T_map_submap
from ldo_service.schemas import GraphCorrection, Keyframe, MeasuredPose, Pose
from tests.actors.conftest import handle_all, without_images


def corrections_of(optimizer: Optimizer, keyframes: list[Keyframe]) -> list[GraphCorrection]:
    return handle_all(optimizer, without_images(keyframes))


def with_references_only(keyframes: list[Keyframe]) -> list[Keyframe]:
    """Return keyframes that are measured against their references alone."""
    return [msgspec.structs.replace(keyframe, window_measurements=()) for keyframe in keyframes]


def test_each_keyframe_gives_a_correction_of_all_poses(keyframes) -> None:
    corrections = corrections_of(Optimizer(), with_references_only(keyframes))
    assert [c.graph_version for c in corrections] == list(range(1, len(keyframes) + 1))
    last = keyframe_poses_from_correction(corrections[-1])
    assert list(last) == [k.keyframe for k in keyframes]
    for keyframe in keyframes:
        np.testing.assert_allclose(
            last[keyframe.keyframe], pose_from_message(keyframe.T_odom_keyframe), atol=1e-6
        )


def test_a_keyframe_sent_twice_counts_once(keyframes) -> None:
    optimizer = Optimizer()
    corrections_of(optimizer, keyframes[:2])
    assert corrections_of(optimizer, keyframes[1:2]) == []
    assert optimizer.metrics()["keyframes_repeated"] == 1


def test_a_missing_reference_is_bridged_by_odometry(keyframes, caplog) -> None:
    optimizer = Optimizer()
    missing = next(k.reference for k in keyframes if k.reference)
    (*_, last) = corrections_of(
        optimizer, [k for k in with_references_only(keyframes) if k.keyframe != missing]
    )
    assert "was never received; using odometry" in caplog.text
    poses = keyframe_poses_from_correction(last)
    newest = keyframes[-1]
    np.testing.assert_allclose(
        poses[newest.keyframe], pose_from_message(newest.T_odom_keyframe), atol=1e-6
    )


def test_window_measurement_replaces_a_missing_reference(keyframes) -> None:
    optimizer = Optimizer()
    *_, last = keyframes
    older = last.window_measurements[-1]
    corrections_of(optimizer, [k for k in keyframes if k.keyframe <= older.reference])
    (correction,) = corrections_of(optimizer, [last])
    poses = keyframe_poses_from_correction(correction)
    T_older_last = se3.inverse(poses[older.reference]) @ poses[last.keyframe]
    np.testing.assert_allclose(
        T_older_last, pose_from_message(older.T_reference_keyframe), atol=1e-6
    )
    assert optimizer.metrics()["keyframes_odometry_fallback"] == 0


def test_window_measurements_reduce_the_pose_error(keyframes, room) -> None:
    truth = room.truth().T_world_camera

    def error_m(corrections: list) -> float:
        last = keyframe_poses_from_correction(corrections[-1])
        T_first_world = se3.inverse(truth[keyframes[0].frame])
        estimated = [last[k.keyframe][:3, 3] for k in keyframes]
        true = [(T_first_world @ truth[k.frame])[:3, 3] for k in keyframes]
        return float(np.sqrt(np.mean(np.square(np.subtract(estimated, true)).sum(axis=1))))

    without_windows = error_m(corrections_of(Optimizer(), with_references_only(keyframes)))
    with_windows = error_m(corrections_of(Optimizer(), keyframes))
    assert with_windows < 0.8 * without_windows


def test_restored_optimizer_republishes_last_correction_and_continues(keyframes) -> None:
    first, second = Optimizer(), Optimizer()
    *_, last = corrections_of(first, keyframes[:-1])
    second.restore(first.snapshot())
    (again,) = second.on_restored()
    assert again.graph_version == last.graph_version + 1, "the last version may have been sent"
    assert (again.stamp_ns, again.keyframes) == (last.stamp_ns, last.keyframes)
    (expected,) = corrections_of(first, keyframes[-1:])
    (correction,) = corrections_of(second, keyframes[-1:])
    for keyframe, T in keyframe_poses_from_correction(correction).items():
        np.testing.assert_allclose(T, keyframe_poses_from_correction(expected)[keyframe], atol=1e-6)


def test_same_keyframes_give_bitwise_equal_corrections(keyframes) -> None:
    one, two = (
        [msgspec.msgpack.encode(c) for c in corrections_of(Optimizer(), keyframes)]
        for _ in range(2)
    )
    assert one == two


def test_an_information_of_zero_does_not_break_the_graph(keyframes) -> None:
    without_information = msgspec.structs.replace(keyframes[1], information=(0.0,) * 36)
    assert len(corrections_of(Optimizer(), [keyframes[0], without_information])) == 2


# --- submaps -------------------------------------------------------------------------------------
def in_two_submaps(keyframes: list[Keyframe], split: int) -> list[Keyframe]:
    """Return the keyframes; keyframe `split` and all later ones are in a second submap."""
    keyframes = with_references_only(keyframes)
    second = msgspec.structs.replace(keyframes[split], submap=1, reference=None)
    later = [
        msgspec.structs.replace(
            k, submap=1, reference=split, T_reference_keyframe=between(second, k)
        )
        for k in keyframes[split + 1 :]
    ]
    return [*keyframes[:split], second, *later]


def between(known: Keyframe, keyframe: Keyframe) -> Pose:
    T_odom_known, T_odom_keyframe = map(
        pose_from_message, (known.T_odom_keyframe, keyframe.T_odom_keyframe)
    )
    return pose_to_message(se3.inverse(T_odom_known) @ T_odom_keyframe)


def with_submap_measurement(keyframe: Keyframe, known: Keyframe) -> Keyframe:
    """Return the keyframe with a submap measurement against a known one."""
    pose = MeasuredPose(
        reference=known.keyframe,
        keyframe=keyframe.keyframe,
        T_reference_keyframe=between(known, keyframe),
        information=keyframe.information,
    )
    return msgspec.structs.replace(keyframe, submap_measurements=(pose,))


def test_a_new_submap_is_placed_far_from_the_others(keyframes) -> None:
    (*_, last) = corrections_of(Optimizer(), in_two_submaps(keyframes, 3))
    assert last.merged_submaps == ()
    for k in keyframes:
        T_odom_keyframe = pose_from_message(k.T_odom_keyframe)
        T_expected = T_odom_keyframe if k.keyframe < 3 else T_map_submap(1) @ T_odom_keyframe
        np.testing.assert_allclose(
            keyframe_poses_from_correction(last)[k.keyframe], T_expected, atol=1e-6
        )


def test_submap_measurement_merges_newer_submap_into_the_older_frame(keyframes, caplog) -> None:
    caplog.set_level("INFO")
    *before, last = in_two_submaps(keyframes, 3)
    first, restored = Optimizer(), Optimizer()
    corrections_of(first, before)
    restored.restore(first.snapshot())
    for optimizer in (first, restored):
        (correction,) = corrections_of(optimizer, [with_submap_measurement(last, keyframes[1])])
        assert correction.merged_submaps == ((1, 0),)
        for k in keyframes:
            np.testing.assert_allclose(
                keyframe_poses_from_correction(correction)[k.keyframe],
                pose_from_message(k.T_odom_keyframe),
                atol=1e-5,
            )
    assert "submap 1 merged into submap 0" in caplog.text
    assert first.metrics()["submaps_unmerged"] == 1


def test_submap_measurement_to_an_unknown_keyframe_is_discarded(keyframes, caplog) -> None:
    *before, last = in_two_submaps(keyframes, 3)
    optimizer = Optimizer()
    corrections_of(optimizer, [k for k in before if k.keyframe != 1])
    (correction,) = corrections_of(optimizer, [with_submap_measurement(last, keyframes[1])])
    assert correction.merged_submaps == ()
    assert "submap measurement to unknown keyframe 1" in caplog.text
