"""Keyframe poses of a component that receives keyframes and corrections."""

import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses, T_map_submap


def random_pose(rng: np.random.Generator, size: float = 0.3) -> np.ndarray:
    return se3.exp(rng.normal(scale=size, size=6))


@pytest.fixture
def steps() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [random_pose(rng) for _ in range(6)]


def chained(steps: list[np.ndarray]) -> KeyframePoses:
    poses = KeyframePoses()
    T_odom = np.eye(4)
    for keyframe, T_reference_keyframe in enumerate(steps):
        T_odom = T_odom @ T_reference_keyframe
        reference = keyframe - 1 if keyframe else None
        poses.add(keyframe, reference, T_reference_keyframe, T_odom)
    return poses


def test_without_corrections_the_map_is_the_odometry(steps) -> None:
    poses = chained(steps)
    for keyframe in range(len(steps)):
        np.testing.assert_allclose(poses.T_map_odom(keyframe), np.eye(4), atol=1e-12)


def test_a_missed_reference_is_bridged_by_odometry(steps) -> None:
    complete = chained(steps)
    with_gap = KeyframePoses()
    T_odom = np.eye(4)
    for keyframe, T_reference_keyframe in enumerate(steps):
        T_odom = T_odom @ T_reference_keyframe
        if keyframe != 3:
            with_gap.add(keyframe, keyframe - 1, T_reference_keyframe, T_odom)
    for keyframe in (0, 1, 2, 4, 5):
        np.testing.assert_allclose(with_gap[keyframe], complete[keyframe], atol=1e-12)


def test_correction_sets_the_pose_of_every_known_keyframe(steps) -> None:
    poses = chained(steps)
    rng = np.random.default_rng(2)
    new = {k: poses[k] @ random_pose(rng, 0.05) for k in reversed(list(poses))}
    poses.correct(1, new | {99: np.eye(4)})
    np.testing.assert_array_equal(poses.of(list(new)), list(new.values()))
    assert 99 not in poses


def test_keyframes_newer_than_a_correction_follow_their_references(steps) -> None:
    poses = chained(steps)
    T_3_5 = se3.inverse(poses[3]) @ poses[5]
    rng = np.random.default_rng(3)
    new = {k: poses[k] @ random_pose(rng, 0.05) for k in range(4)}
    poses.correct(1, new)
    np.testing.assert_allclose(se3.inverse(poses[3]) @ poses[5], T_3_5, atol=1e-12)


@pytest.mark.parametrize("reference", [1, 4])
def test_order_of_correction_and_keyframe_does_not_matter(steps, reference: int) -> None:
    rng = np.random.default_rng(4)
    before, after = chained(steps[:5]), chained(steps[:5])
    new = {k: before[k] @ random_pose(rng, 0.05) for k in range(5)}  # Each moves differently.
    T_odom_5 = before[reference] @ steps[5]
    before.add(5, reference, steps[5], T_odom_5)
    before.correct(1, new)
    after.correct(1, new)
    after.add(5, reference, steps[5], T_odom_5)
    np.testing.assert_allclose(before[5], after[5], atol=1e-12)
    np.testing.assert_allclose(after[5], new[reference] @ steps[5], atol=1e-12)


def test_an_older_correction_changes_nothing(steps) -> None:
    poses = chained(steps)
    poses.correct(2, {0: se3.exp(np.full(6, 0.1))})
    before = poses[0]
    poses.correct(1, {0: np.eye(4)})
    assert poses.version == 2
    np.testing.assert_array_equal(poses[0], before)


def test_snapshot_and_restore_are_exact(steps) -> None:
    poses, restored = chained(steps), KeyframePoses()
    poses.correct(3, {k: poses[k] @ steps[0] for k in range(4)})
    restored.restore(poses.snapshot())
    assert restored.version == 3
    assert list(restored) == list(poses)
    for keyframe in poses:
        np.testing.assert_array_equal(restored[keyframe], poses[keyframe])
        np.testing.assert_array_equal(restored.T_map_odom(keyframe), poses.T_map_odom(keyframe))


def test_new_submap_is_far_away_until_a_correction_merges_it(steps) -> None:
    poses = chained(steps)
    T_odom = poses[len(steps) - 1]
    poses.add(50, None, np.eye(4), T_odom, submap=2)
    poses.add(51, 50, steps[1], T_odom @ steps[1], submap=2)
    np.testing.assert_allclose(poses[50], T_map_submap(2) @ T_odom)
    assert min(np.linalg.norm(poses[51][:3, 3] - poses[k][:3, 3]) for k in range(len(steps))) > 100
    poses.correct(1, {0: poses[0], 50: T_odom})
    np.testing.assert_allclose(poses[51], T_odom @ steps[1], atol=1e-12)


def test_first_keyframe_of_a_submap_is_merged_despite_a_held_measurement(steps) -> None:
    poses = chained(steps)
    T_odom = poses[len(steps) - 1]
    poses.add(50, None, np.eye(4), T_odom, submap=2)
    poses.add(51, 50, steps[1], T_odom @ steps[1], submap=2)
    poses.correct(1, {0: poses[0], 50: T_odom, 51: T_odom}, held=(50, 51))
    np.testing.assert_allclose(poses[50], T_odom, atol=1e-12)
    np.testing.assert_allclose(poses[51], T_odom @ steps[1], atol=1e-12)


def test_a_missed_keyframe_is_bridged_within_its_submap() -> None:
    poses = KeyframePoses()
    poses.add(0, None, np.eye(4), np.eye(4))
    poses.add(1, None, np.eye(4), np.eye(4), submap=1)
    T_odom = se3.exp(np.full(6, 0.1))
    poses.add(3, 2, np.eye(4), T_odom, submap=0)
    np.testing.assert_allclose(poses[3], T_odom)
