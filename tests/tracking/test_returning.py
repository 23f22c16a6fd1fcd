"""Which known keyframes a camera may go on against, and what becomes of odometry then."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.detection.dynamic_classes import Box
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import (
    Odometry,
    OdometryConfig,
    PyramidConfig,
    Status,
    Tracked,
    pyramid_of,
)
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import Place, PlacesConfig, place_of
from ldo_service.tracking.keyframes import Keyframe, KeyframeConfig
from ldo_service.tracking.relocalization import ReturnConfig, nearby

SOON = OdometryConfig(returning=ReturnConfig(after=1))


def moved(x_m: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([0.0, turn_rad, 0.0, x_m, 0.0, 0.0]))


def place_at(room, number: int) -> Place:
    keyframe = Keyframe(pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), number)
    return replace(place_of(keyframe, FeatureConfig(), PlacesConfig()), median_depth_m=2.0)


def returned_at(
    odometry: Odometry,
    frame: RgbdFrame,
    tracked: Tracked,
    T_map_keyframe: Mapping[int, np.ndarray],
    T_map_camera: np.ndarray,
) -> Tracked | None:
    seen = odometry.seen_again(frame, tracked, T_map_keyframe, T_map_camera)
    return None if seen is None else odometry.return_to(seen, tracked)


def followed(odometry: Odometry, room, poses: list[np.ndarray]) -> tuple[list[Tracked], dict]:
    """Tracks along the poses; also the true T_odom_keyframe [4, 4] of the keyframes made."""
    results, made = [], {}
    for index, T in enumerate(poses):
        frame = room.view(T, index=index)
        results.append(odometry.track(frame))
        if results[-1].wants_keyframe:
            made[odometry.make_keyframe(frame, results[-1])] = T
        elif results[-1].wants_mapping:
            made[odometry.make_supporting(frame, results[-1])] = T
    return results, made


# --- which are near -------------------------------------------------------------------------------
def test_places_are_near_until_a_keyframe_is_due_the_nearest_first(room) -> None:
    config = KeyframeConfig(max_translation=0.1, max_rotation_rad=0.2)  # 0.2 m of 2 m
    places = [place_at(room, number) for number in range(5)]
    T_map = {0: moved(0.19), 1: moved(0.21), 2: moved(-0.05), 3: moved(0, 0.15), 4: moved(0, -0.25)}
    near = nearby(places, T_map, np.eye(4), config)
    assert [place.id for place, _ in near] == [2, 3, 0]
    for place, T_place_camera in near:
        np.testing.assert_allclose(T_map[place.id] @ T_place_camera, np.eye(4), atol=1e-12)


def test_places_that_the_map_does_not_have_are_left_out(room) -> None:
    places = [place_at(room, number) for number in range(2)]
    assert [p.id for p, _ in nearby(places, {1: np.eye(4)}, np.eye(4), KeyframeConfig())] == [1]
    assert nearby(places, {}, np.eye(4), KeyframeConfig()) == []


def due_on_the_way_back(
    odometry: Odometry, room, there: list[np.ndarray]
) -> tuple[RgbdFrame, Tracked, np.ndarray]:
    """The first frame that wants a keyframe, and its true pose."""
    for T in reversed(there[:-1]):
        frame = room.view(T)
        tracked = odometry.track(frame)
        if tracked.wants_keyframe:
            return frame, tracked, T
    raise AssertionError("no keyframe was due")


# --- odometry -------------------------------------------------------------------------------------
def left_and_back(room, make_walk, T_error: np.ndarray) -> tuple[Odometry, Tracked | None, Tracked]:
    """There and back to where a keyframe is due, then asked to return in a map off by T_error."""
    odometry, there = Odometry(SOON), make_walk(20)
    _, T_map = followed(odometry, room, there)
    frame, tracked, T = due_on_the_way_back(odometry, room, there)
    known = {number: T for number, T in T_map.items() if number != tracked.keyframe}
    return odometry, returned_at(odometry, frame, tracked, known, T @ T_error), tracked


def test_odometry_goes_on_where_it_is_against_the_known_keyframe(room, make_walk) -> None:
    odometry, returned, tracked = left_and_back(room, make_walk, np.eye(4))
    assert returned is not None
    assert returned.keyframe == odometry.keyframe
    assert returned.keyframe != tracked.keyframe
    assert (returned.status, returned.method) == (Status.OK, "returned")
    assert not returned.wants_keyframe
    assert not returned.wants_mapping
    np.testing.assert_array_equal(returned.T_odom_camera, tracked.T_odom_camera)
    again = odometry.track(room.view(tracked.T_odom_camera))
    assert again.keyframe == returned.keyframe
    np.testing.assert_allclose(again.T_odom_camera, tracked.T_odom_camera, atol=3e-3)


def test_what_a_known_keyframe_shows_is_not_mapped_again(room, make_walk) -> None:
    odometry, returned, _ = left_and_back(room, make_walk, np.eye(4))
    assert returned is not None
    step = se3.exp(np.array([0, 0.1, 0, 0, 0, 0]))  # worth mapping, but for that
    tracked = odometry.track(room.view(returned.T_odom_camera @ step))
    assert tracked.keyframe == returned.keyframe
    assert tracked.status is Status.OK
    assert not tracked.wants_mapping or tracked.wants_keyframe
    odometry.make_keyframe(room.view(tracked.T_odom_camera), tracked)
    ahead = odometry.track(room.view(tracked.T_odom_camera @ step))
    assert ahead.wants_mapping, "of a new keyframe it is mapped"


def test_nobody_returns_where_map_and_images_disagree(room, make_walk) -> None:
    _, returned, _ = left_and_back(room, make_walk, moved(turn_rad=0.06))
    assert returned is None


def test_nobody_returns_to_what_looks_otherwise_now(room, make_walk) -> None:
    odometry, there = Odometry(SOON), make_walk(20)
    _, T_map = followed(odometry, room, there)
    _, tracked, T = due_on_the_way_back(odometry, room, there)
    known = {number: T for number, T in T_map.items() if number != tracked.keyframe}
    assert returned_at(odometry, room.blank(), tracked, known, T) is None
    assert returned_at(odometry, room.view(T), tracked, known, T) is not None


def test_the_next_frames_after_a_return_survive_a_restart_bit_for_bit(room, make_walk) -> None:
    odometry, returned, _ = left_and_back(room, make_walk, np.eye(4))
    assert returned is not None
    successor = Odometry(SOON)
    successor.restore(decode_state(encode_state(odometry.state())))
    for step in (0.01, 0.03, 0.06):
        view = room.view(returned.T_odom_camera @ moved(step))
        a, b = odometry.track(view), successor.track(view)
        assert a.T_odom_camera.tobytes() == b.T_odom_camera.tobytes()
        assert (a.keyframe, a.wants_mapping) == (b.keyframe, b.wants_mapping)


def test_a_keyframe_made_after_a_return_is_measured_from_those_returned_to(room, make_walk) -> None:
    """Odometry has them elsewhere than before, as after a long way, and the window must know."""
    odometry, there = Odometry(SOON), make_walk(45)
    _, T_map = followed(odometry, room, there)
    places = odometry._state.places
    far = tuple(replace(p, T_odom_keyframe=moved(0.4) @ p.T_odom_keyframe) for p in places.all)
    odometry._state = replace(odometry._state, places=replace(places, all=far))
    seen = []
    for T in reversed(there[:-1]):
        frame = room.view(T)
        tracked = odometry.track(frame)
        if tracked.wants_keyframe:
            returned = returned_at(odometry, frame, tracked, T_map, T)
            assert returned is not None
            seen.append(returned.keyframe)
    assert len(seen) > 2
    aside = room.view(there[0] @ moved(turn_rad=0.3))
    odometry.track(aside)
    tracked = odometry.track(aside)
    assert tracked.wants_keyframe
    made = odometry.make_keyframe(aside, tracked)
    window = odometry.window(tracked)
    assert {measured.a for measured in window} <= {*seen}
    assert window
    for measured in window:
        assert measured.b == made
        T_true = se3.inverse(T_map[measured.a]) @ there[0] @ moved(turn_rad=0.3)
        np.testing.assert_allclose(measured.T_a_b, T_true, atol=1e-2)


@pytest.mark.parametrize(
    "wrong",
    [{"after": -1}, {"tries": 0}, {"agreement_rad": 0.0}, {"min_geometric_inliers": 1.5}],
)
def test_settings_that_cannot_be_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        ReturnConfig(**wrong)


def test_a_camera_that_moves_slowly_stays_with_the_keyframe_it_returned_to(room, make_walk) -> None:
    """A new one is due after so many frames; an old one shows the same after a year."""
    odometry, returned, _ = left_and_back(room, make_walk, np.eye(4))
    assert returned is not None
    steps = [returned.T_odom_camera @ moved(5e-4 * k, 2e-3 * (k % 2)) for k in range(40)]
    results, made = followed(odometry, room, steps)
    assert made == {}
    assert {result.keyframe for result in results} == {returned.keyframe}


def test_what_was_put_there_since_then_is_not_taken_for_something_that_moves(
    room, make_walk
) -> None:
    odometry, returned, _ = left_and_back(room, make_walk, np.eye(4))
    assert returned is not None
    tracked = odometry.track(with_a_box(room.view(returned.T_odom_camera)))
    assert tracked.status is Status.OK
    assert tracked.keyframe == returned.keyframe
    assert tracked.is_moving is None


def test_of_a_new_keyframe_something_that_comes_is_taken_to_move(room) -> None:
    odometry = Odometry(SOON)
    first = room.view(np.eye(4))
    odometry.make_keyframe(first, odometry.track(first))
    tracked = odometry.track(with_a_box(room.view(np.eye(4))))
    assert tracked.is_moving is not None
    assert tracked.is_moving[55, 75]


def with_a_box(frame: RgbdFrame) -> RgbdFrame:
    color, depth_m = frame.color.copy(), frame.depth_m.copy()
    color[40:70, 60:90] = np.random.default_rng(0).integers(60, 200, (30, 30, 1))
    depth_m[40:70, 60:90] = 1.0
    return replace(frame, color=color, depth_m=depth_m)


def test_whom_a_detector_found_is_not_in_the_place_either(room) -> None:
    odometry = Odometry(SOON)
    frame = room.view(np.eye(4))
    number = odometry.make_keyframe(frame, odometry.track(frame))
    before = odometry._state.places.all[0]
    odometry.leave_out(number, [Box("person", 40.0, 30.0, 90.0, 100.0)])
    (after,) = odometry._state.places.all
    assert np.count_nonzero(before.depth_m[50:80, 50:80]) > 800
    assert np.count_nonzero(after.depth_m[50:80, 50:80]) < 300


def test_a_lost_camera_that_is_found_again_maps_nothing_anew(room, make_walk) -> None:
    odometry, there = Odometry(SOON), make_walk(60)
    followed(odometry, room, there)
    odometry.track(room.blank())
    found = odometry.track(room.view(there[2]))
    assert (found.status, found.method) == (Status.OK, "relocalised")
    assert not found.wants_mapping or found.wants_keyframe
    assert odometry.is_tied


@pytest.mark.parametrize(("after", "may"), [(0, False), (3, False), (2, True)])
def test_known_keyframes_do_once_there_are_many(room, after: int, may: bool) -> None:
    odometry = Odometry(OdometryConfig(returning=ReturnConfig(after=after)))
    for number in range(2):
        frame = room.view(moved(0.02 * number))
        odometry.make_keyframe(frame, odometry.track(frame))
    assert odometry.may_return is may
