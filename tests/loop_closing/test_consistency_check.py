"""Tests of the check of loop candidates against the keyframe poses."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig, ConsistencyChecker

CONFIG = ConsistencyCheckConfig()


def view(keyframe: int, path_m: float, submap: int = 0) -> Any:
    place = SimpleNamespace(submap=submap, median_depth_m=2.0)
    return SimpleNamespace(keyframe=keyframe, path_m=path_m, place=place)


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
