"""Tests of the check of loop candidates against the keyframe poses."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig, ConsistencyChecker

CONFIG = ConsistencyCheckConfig()


def view(keyframe: int, path_m: float, submap: int = 0, frame: int = 0) -> Any:
    place = SimpleNamespace(submap=submap, median_depth_m=2.0)
    return SimpleNamespace(keyframe=keyframe, path_m=path_m, place=place, frame=frame)


def keyframe_poses(*twists: tuple[float, ...]) -> KeyframePoses:
    poses = KeyframePoses()
    for number, xi in enumerate(twists):
        poses.add(number, None, np.eye(4), se3.exp(np.array(xi, float)))
    return poses


@pytest.mark.parametrize(
    ("xi", "expected"),
    [
        ((0, 0, 0, 5.4, 0, 0), True),  # Limit 5.5 m: 0.5 m + 10 % of 10 m + twice the depth of 2 m.
        ((0, 0, 0, 5.6, 0, 0), False),
        ((0, 2.0, 0, 0, 0, 0), True),  # Limit 2.05 rad: 0.35 + 0.2 + 1.5.
        ((0, 2.1, 0, 0, 0, 0), False),
    ],
)
def test_keyframe_beyond_drift_and_view_is_no_possible_match(xi, expected) -> None:
    checker = ConsistencyChecker(keyframe_poses((0,) * 6, xi), {}, CONFIG)
    assert checker.possible_matches([view(0, 0.0)], view(1, 10.0)).tolist() == [expected]


def test_keyframes_without_a_known_relative_pose_are_possible_matches() -> None:
    far = (0, 3.0, 0, 100, 0, 0)
    new = view(1, 10.0)
    poses = keyframe_poses((0,) * 6, far)
    separate, merged = (ConsistencyChecker(poses, j, CONFIG) for j in ({}, {1: 0}))
    assert separate.possible_matches([view(0, 0.0, submap=1)], new).tolist() == [True]
    assert merged.possible_matches([view(0, 0.0, submap=1)], new).tolist() == [False]
    assert separate.possible_matches([view(7, 0.0), view(0, 0.0)], new).tolist() == [True, False]
    assert separate.possible_matches([], new).tolist() == []


def subgraph(*views: Any) -> Any:
    return SimpleNamespace(views=views, submap=views[0].place.submap)


def test_image_motion_is_the_smallest_between_keyframes_of_both_subgraphs() -> None:
    """A distance of 1 m is a parallax of 0.5 rad at a depth of 2 m."""
    poses = keyframe_poses((0,) * 6, (0, 0, 0, 3, 0, 0), (0, 0, 0, 4, 0, 0), (0, 0.3, 0, 5, 0, 0))
    old = [subgraph(view(0, 0.0), view(1, 3.0)), subgraph(view(0, 0.0))]
    new = subgraph(view(2, 4.0, frame=500), view(3, 5.0, frame=520))
    checker = ConsistencyChecker(poses, {}, CONFIG)
    motions_rad = checker.image_motions(old, new, np.array([True, True]), 100)
    np.testing.assert_allclose(motions_rad, [0.5, 2.0])
    assert checker.image_motions([], new, np.zeros(0, bool), 100).tolist() == []


def test_image_motion_leaves_out_keyframes_that_are_too_recent_for_a_closure() -> None:
    """The keyframes of the subgraph before the new one are the nearest, but mostly too recent."""
    poses = keyframe_poses(*((0, 0, 0, x_m, 0, 0) for x_m in (2.2, 0, 2, 2.4, 4.0)))
    revisited = subgraph(view(0, 0.0, frame=0))
    before = subgraph(view(1, 8.0, frame=400), view(2, 10.0, frame=460))
    new = subgraph(view(3, 10.4, frame=470), view(4, 12.0, frame=520), view(9, 12.0, frame=900))
    checker, possible = ConsistencyChecker(poses, {}, CONFIG), np.array([True, True])

    def motions_rad(min_gap_frames: int) -> np.ndarray:
        return checker.image_motions([revisited, before], new, possible, min_gap_frames)

    np.testing.assert_allclose(motions_rad(100), [0.1, 2.0])
    np.testing.assert_allclose(motions_rad(9), [0.1, 0.2])
    np.testing.assert_allclose(motions_rad(120), [0.1, np.inf])


def test_image_motion_is_infinite_without_a_known_relative_pose() -> None:
    poses = keyframe_poses((0,) * 6, (0,) * 6)
    old = [subgraph(view(0, 0.0)), subgraph(view(0, 0.0, submap=1)), subgraph(view(9, 0.0))]
    separate, merged = (ConsistencyChecker(poses, j, CONFIG) for j in ({}, {1: 0}))
    new, possible = subgraph(view(1, 1.0, frame=500)), np.array([False, True, True])
    assert separate.image_motions(old, new, possible, 100).tolist() == [np.inf] * 3
    assert merged.image_motions(old, new, possible, 100).tolist() == [np.inf, 0, np.inf]
    unknown = subgraph(view(8, 1.0, frame=500))
    assert merged.image_motions(old, unknown, possible, 100).tolist() == [np.inf] * 3
