import numpy as np
import pytest

from ldo_service.geometry import se3
from ldo_service.tracking import OdometryConfig, PyramidConfig, TrackingStatus, pyramid_of
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabase,
    KeyframeDatabaseConfig,
    make_keyframe_record,
)
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.localizer import Localizer, MapFix
from ldo_service.tracking.submaps import SubmapConfig

T_MAP_WORLD = se3.exp(np.array([0.1, -0.7, 0.2, 3.0, 1.0, -2.0]))
T_BEHIND = se3.exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
CONFIG = OdometryConfig(submaps=SubmapConfig(begin_after_s=0.06, look_every=4, confirm_after=2))


@pytest.fixture(scope="module")
def places(large_room, make_walk) -> KeyframeDatabase:
    """A map in a frame of its own."""
    made = []
    for number, T_world_camera in enumerate(make_walk(3, 0.15, 0.1)):
        view = pyramid_of(large_room.view(T_world_camera), PyramidConfig())
        keyframe = ReferenceKeyframe(view, T_MAP_WORLD @ T_world_camera, number)
        made.append(make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig()))
    return KeyframeDatabase(tuple(made))


def located(localizer: Localizer, room, truth: list[np.ndarray]) -> list[float | None]:
    """Errors in the map, m; None where the camera is not found."""
    errors: list[float | None] = []
    for index, T_world_camera in enumerate(truth):
        frame = room.view(T_world_camera, stamp_ns=index * 33_333_333, index=index)
        result = localizer.process(frame)
        assert (result.reference, result.keyframe) == (None, None)
        if result.status is TrackingStatus.LOST:
            errors.append(None)
            continue
        T_error = (
            se3.inverse(T_MAP_WORLD @ T_world_camera) @ result.T_map_odom @ result.T_odom_camera
        )
        errors.append(float(np.linalg.norm(T_error[:3, 3])))
    return errors


def test_a_camera_is_found_at_the_second_look_and_followed(large_room, make_walk, places) -> None:
    first, *rest = located(Localizer(places, CONFIG), large_room, make_walk(14))
    assert first is None, "one look is not believed"
    assert max(error for error in rest if error is not None) < 5e-3
    assert None not in rest


def test_a_camera_in_a_strange_place_is_not_found(large_room, make_walk, places) -> None:
    strange = [T_BEHIND @ T for T in make_walk(8)]
    assert located(Localizer(places, CONFIG), large_room, strange) == [None] * 8


def test_after_a_kidnap_the_old_fix_is_forgotten(large_room, make_walk, places) -> None:
    here, there = make_walk(6), [T_BEHIND @ T for T in make_walk(8)]
    localizer = Localizer(places, CONFIG)
    errors = located(localizer, large_room, [*here, *there, *here])
    assert errors[6:14] == [None] * 8, "the new submap of odometry was not found in the map"
    back = [error for error in errors[14:] if error is not None]
    assert len(back) >= 4
    assert max(back) < 5e-3


def test_a_fix_survives_packing(large_room, make_walk, places) -> None:
    localizer = Localizer(places, CONFIG)
    located(localizer, large_room, make_walk(4))
    fix, again = localizer._fix, MapFix.unpack(localizer.snapshot()["fix"])
    np.testing.assert_array_equal(again.T_map_odom, fix.T_map_odom)
    assert again.pending_match is not None
    assert again.frames_since_search == fix.frames_since_search
