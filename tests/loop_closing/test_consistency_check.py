"""What a map has to say of a pose."""

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


def poses_of(*twists: tuple[float, ...]) -> KeyframePoses:
    poses = KeyframePoses()
    for number, xi in enumerate(twists):
        poses.add(number, None, np.eye(4), se3.exp(np.array(xi, float)))
    return poses


@pytest.mark.parametrize(
    ("xi", "expected"),
    [
        ((0, 0, 0, 5.4, 0, 0), True),  # 0.5 m + 10 % of 10 m, and two depths of 2 m: 5.5 m
        ((0, 0, 0, 5.6, 0, 0), False),
        ((0, 2.0, 0, 0, 0, 0), True),  # 0.35 + 0.2 + 1.5 rad
        ((0, 2.1, 0, 0, 0, 0), False),
    ],
)
def test_a_place_beyond_drift_and_view_is_not_asked(xi, expected) -> None:
    known = ConsistencyChecker(poses_of((0,) * 6, xi), {}, CONFIG)
    assert known.possible_matches([view(0, 0.0)], view(1, 10.0)).tolist() == [expected]


def test_where_the_map_knows_nothing_everything_may_be() -> None:
    far = (0, 3.0, 0, 100, 0, 0)
    new = view(1, 10.0)
    poses = poses_of((0,) * 6, far)
    apart, joined = (ConsistencyChecker(poses, j, CONFIG) for j in ({}, {1: 0}))
    assert apart.possible_matches([view(0, 0.0, submap=1)], new).tolist() == [True]
    assert joined.possible_matches([view(0, 0.0, submap=1)], new).tolist() == [False]
    assert apart.possible_matches([view(7, 0.0), view(0, 0.0)], new).tolist() == [True, False]
    assert apart.possible_matches([], new).tolist() == []
