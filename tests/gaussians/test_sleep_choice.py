import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.gaussians.anchor_spheres import AnchorSpheres, PlacedCamera
from ldo_service.gaussians.sleep_choice import SleepConfig, choose_sleepers
from ldo_service.geometry import Camera, se3

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
AT_HOME = {k: np.eye(4) for k in range(10)}
CONFIG = SleepConfig(max_active=100, low_water=0.6, reach_m=50)


def along_the_corridor(*z_m: float, each: int = 20) -> AnchorSpheres:
    """Anchors of 20 Gaussians at these distances in front of the map's origin."""
    centers = np.array([(0, 0, z) for z in z_m], float)
    count = len(z_m)
    return AnchorSpheres(
        np.arange(count, dtype=np.int32), np.full(count, each), centers, np.full(count, 0.5)
    )


def camera_at(z_m: float) -> PlacedCamera:
    """Looks forward: what lies behind is not seen."""
    T_map_camera = np.eye(4)
    T_map_camera[2, 3] = z_m
    return PlacedCamera(CAMERA, T_map_camera)


def test_nobody_sleeps_up_to_the_cap() -> None:
    choice = choose_sleepers(along_the_corridor(1, 2, 3, 4, 5), AT_HOME, [camera_at(30)], CONFIG)
    assert (choice.anchors, choice.excess) == ([], 0)


def test_the_farthest_go_first_down_to_the_low_water_mark() -> None:
    awake = along_the_corridor(20, 2, 9, 4, 25, 31, 32)
    choice = choose_sleepers(awake, AT_HOME, [camera_at(30)], CONFIG)
    assert choice.anchors == [1, 3, 2, 0]  # 140 - 80 = 60
    assert choice.excess == 0


def test_of_two_at_the_same_distance_the_older_goes() -> None:
    choice = choose_sleepers(along_the_corridor(5, 3, 3, 3, 5, 6), AT_HOME, [camera_at(30)], CONFIG)
    assert choice.anchors == [1, 2, 3]


def test_those_a_recent_camera_sees_and_the_newest_stay_even_over_the_cap() -> None:
    awake = along_the_corridor(1, 2, 3, 34, 35, 36, -5)
    choice = choose_sleepers(awake, AT_HOME, [camera_at(1.8), camera_at(30)], CONFIG)
    assert choice.anchors == [0]  # 1 and 2 are seen by the first camera, 6 is the newest
    assert choice.excess == 20


def test_what_is_out_of_reach_is_not_seen() -> None:
    awake = along_the_corridor(61, 62, 63, 64, 65, 66)
    near, far = camera_at(30), camera_at(0)
    assert choose_sleepers(awake, AT_HOME, [near], CONFIG).anchors == []
    assert choose_sleepers(awake, AT_HOME, [far], CONFIG).anchors == [4, 3, 2]


def test_anchors_are_looked_for_where_they_are_now() -> None:
    awake = along_the_corridor(1, 31, 31, 31, 31, 31)
    behind = {**AT_HOME, 2: se3.exp(np.array([0, 0, 0, 0, 0, -12]))}
    assert choose_sleepers(awake, behind, [camera_at(30)], CONFIG).anchors == [0, 2]


@pytest.mark.parametrize("change", [{"max_active": 0}, {"low_water": 0}, {"reach_m": 0}])
def test_senseless_configuration_is_refused(change: dict) -> None:
    with pytest.raises(ConfigError):
        SleepConfig(**change)
