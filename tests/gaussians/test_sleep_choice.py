from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians.visibility import (
    BoundingSpheres,
    MaxDepthGrid,
    OffloadConfig,
    OffloadPlan,
    PlacedCamera,
    plan_offload,
)
from ldo_service.geometry import Camera

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
CONFIG = OffloadConfig(max_active=100, low_water=0.6, reach_m=50)


def along_the_corridor(*z_m: float, each: int = 20) -> BoundingSpheres:
    """Anchors of 20 Gaussians at these distances in front of the map's origin."""
    centers = np.array([(0, 0, z) for z in z_m], float)
    count = len(z_m)
    return BoundingSpheres(
        np.arange(count, dtype=np.int32), np.full(count, each), centers, np.full(count, 0.5)
    )


def camera_at(z_m: float) -> PlacedCamera:
    """Looks forward: what lies behind is not seen."""
    T_map_camera = np.eye(4)
    T_map_camera[2, 3] = z_m
    return PlacedCamera(CAMERA, T_map_camera)


def test_nobody_sleeps_up_to_the_cap() -> None:
    choice = plan_offload(along_the_corridor(1, 2, 3, 4, 5), [camera_at(30)], CONFIG)
    assert (choice.clumps, choice.excess) == ([], 0)


def test_the_farthest_go_first_down_to_the_low_water_mark() -> None:
    awake = along_the_corridor(20, 2, 9, 4, 25, 31, 32)
    choice = plan_offload(awake, [camera_at(30)], CONFIG)
    assert choice.clumps == [1, 3, 2, 0]  # 140 - 80 = 60
    assert choice.excess == 0


def test_of_two_at_the_same_distance_the_older_goes() -> None:
    choice = plan_offload(along_the_corridor(5, 3, 3, 3, 5, 6), [camera_at(30)], CONFIG)
    assert choice.clumps == [1, 2, 3]


def test_those_a_recent_camera_sees_and_the_newest_stay_even_over_the_cap() -> None:
    awake = along_the_corridor(1, 2, 3, 34, 35, 36, -5)
    choice = plan_offload(awake, [camera_at(1.8), camera_at(30)], CONFIG)
    assert choice.clumps == [0]  # 1 and 2 are seen by the first camera, 6 is the newest
    assert choice.excess == 20


def test_what_is_out_of_reach_is_not_seen() -> None:
    awake = along_the_corridor(61, 62, 63, 64, 65, 66)
    near, far = camera_at(30), camera_at(0)
    assert plan_offload(awake, [near], CONFIG).clumps == []
    assert plan_offload(awake, [far], CONFIG).clumps == [4, 3, 2]


def test_clumps_of_one_anchor_go_one_by_one() -> None:
    awake = along_the_corridor(1, 31, 2, 32, 3, 33)
    awake.anchors[:] = 0, 0, 0, 0, 0, 1
    assert plan_offload(awake, [camera_at(30)], CONFIG).clumps == [0, 2, 4]


def test_what_is_behind_a_wall_goes() -> None:
    """All lie ahead of the camera, which saw a wall 4 m away."""
    awake = along_the_corridor(31, 32, 33, 40, 45, 50)
    wall = MaxDepthGrid.of(np.full((48, 64), 4, np.float32))
    blind = replace(camera_at(30), horizon=wall)
    assert plan_offload(awake, [camera_at(30)], CONFIG) == OffloadPlan([], 20)
    assert plan_offload(awake, [blind], CONFIG).clumps == [4, 3]


@pytest.mark.parametrize(
    "change", [{"max_active": 0}, {"low_water": 0}, {"reach_m": 0}, {"clump_m": 0}]
)
def test_senseless_configuration_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        OffloadConfig(**change)
