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


def spheres_at(*z_m: float, each: int = 20) -> BoundingSpheres:
    """Return spheres of `each` Gaussians at these distances in front of the map origin."""
    centers = np.array([(0, 0, z) for z in z_m], float)
    count = len(z_m)
    return BoundingSpheres(
        np.arange(count, dtype=np.int32), np.full(count, each), centers, np.full(count, 0.5)
    )


def camera_at(z_m: float) -> PlacedCamera:
    """Return a camera at z_m that looks forward."""
    T_map_camera = np.eye(4)
    T_map_camera[2, 3] = z_m
    return PlacedCamera(CAMERA, T_map_camera)


def test_no_chunk_is_offloaded_up_to_the_cap() -> None:
    plan = plan_offload(spheres_at(1, 2, 3, 4, 5), [camera_at(30)], CONFIG)
    assert (plan.chunks, plan.excess) == ([], 0)


def test_farthest_chunks_are_offloaded_to_the_low_water_mark() -> None:
    spheres = spheres_at(20, 2, 9, 4, 25, 31, 32)
    plan = plan_offload(spheres, [camera_at(30)], CONFIG)
    assert plan.chunks == [1, 3, 2, 0]  # 140 - 80 = 60 remain.
    assert plan.excess == 0


def test_older_chunk_is_offloaded_at_equal_distance() -> None:
    plan = plan_offload(spheres_at(5, 3, 3, 3, 5, 6), [camera_at(30)], CONFIG)
    assert plan.chunks == [1, 2, 3]


def test_recently_visible_and_newest_chunks_stay_above_the_cap() -> None:
    spheres = spheres_at(1, 2, 3, 34, 35, 36, -5)
    plan = plan_offload(spheres, [camera_at(1.8), camera_at(30)], CONFIG)
    assert plan.chunks == [0]  # The first camera sees 1 and 2; 6 is the newest.
    assert plan.excess == 20


def test_chunks_out_of_reach_are_offloaded() -> None:
    spheres = spheres_at(61, 62, 63, 64, 65, 66)
    near, far = camera_at(30), camera_at(0)
    assert plan_offload(spheres, [near], CONFIG).chunks == []
    assert plan_offload(spheres, [far], CONFIG).chunks == [4, 3, 2]


def test_chunks_of_one_anchor_are_offloaded_separately() -> None:
    spheres = spheres_at(1, 31, 2, 32, 3, 33)
    spheres.anchors[:] = 0, 0, 0, 0, 0, 1
    assert plan_offload(spheres, [camera_at(30)], CONFIG).chunks == [0, 2, 4]


def test_chunks_behind_a_wall_are_offloaded() -> None:
    """The spheres lie in front of the camera, which measured a wall at 4 m."""
    spheres = spheres_at(31, 32, 33, 40, 45, 50)
    wall = MaxDepthGrid.of(np.full((48, 64), 4, np.float32))
    camera_at_wall = replace(camera_at(30), horizon=wall)
    assert plan_offload(spheres, [camera_at(30)], CONFIG) == OffloadPlan([], 20)
    assert plan_offload(spheres, [camera_at_wall], CONFIG).chunks == [4, 3]


@pytest.mark.parametrize(
    "change", [{"max_active": 0}, {"low_water": 0}, {"reach_m": 0}, {"chunk_edge_m": 0}]
)
def test_invalid_settings_raise_config_error(change: dict) -> None:
    with pytest.raises(ConfigError):
        OffloadConfig(**change)
