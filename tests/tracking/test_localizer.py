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
CONFIG = OdometryConfig(
    submaps=SubmapConfig(begin_after_frames=9, search_interval_frames=4, confirm_after=2)
)


@pytest.fixture(scope="module")
def database(large_room, make_walk) -> KeyframeDatabase:
    """Return a keyframe database in a map frame of its own."""
    records = []
    for number, T_world_camera in enumerate(make_walk(3, 0.15, 0.1)):
        view = pyramid_of(large_room.view(T_world_camera), PyramidConfig())
        keyframe = ReferenceKeyframe(view, T_MAP_WORLD @ T_world_camera, number)
        records.append(make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig()))
    return KeyframeDatabase(tuple(records))


def localization_errors_m(
    localizer: Localizer, room, truth: list[np.ndarray]
) -> list[float | None]:
    """Return position errors in the map, m; None where the camera is LOST."""
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


def test_camera_is_localized_at_the_second_match_and_tracked(
    large_room, make_walk, database
) -> None:
    first, *rest = localization_errors_m(Localizer(database, CONFIG), large_room, make_walk(14))
    assert first is None, "one match alone is not accepted"
    assert max(error for error in rest if error is not None) < 5e-3
    assert None not in rest


def test_camera_in_an_unknown_place_is_not_localized(large_room, make_walk, database) -> None:
    unknown = [T_BEHIND @ T for T in make_walk(8)]
    assert localization_errors_m(Localizer(database, CONFIG), large_room, unknown) == [None] * 8


def test_map_fix_is_dropped_after_a_jump(large_room, make_walk, database) -> None:
    in_map, outside_map = make_walk(6), [T_BEHIND @ T for T in make_walk(8)]
    localizer = Localizer(database, CONFIG)
    errors = localization_errors_m(localizer, large_room, [*in_map, *outside_map, *in_map])
    assert errors[6:14] == [None] * 8, "the new odometry submap has no fix in the map"
    back = [error for error in errors[14:] if error is not None]
    assert len(back) >= 4
    assert max(back) < 5e-3


def test_map_fix_survives_packing(large_room, make_walk, database) -> None:
    localizer = Localizer(database, CONFIG)
    localization_errors_m(localizer, large_room, make_walk(4))
    fix, restored = localizer._fix, MapFix.unpack(localizer.snapshot()["fix"])
    np.testing.assert_array_equal(restored.T_map_odom, fix.T_map_odom)
    assert restored.pending_match is not None
    assert restored.frames_since_search == fix.frames_since_search
