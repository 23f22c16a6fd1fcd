"""Which known keyframes a camera may go on against, and what becomes of odometry then."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from ldo_service.detection.dynamic_classes import Box
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking import (
    AlignConfig,
    Odometry,
    OdometryConfig,
    PyramidConfig,
    TrackingResult,
    TrackingStatus,
    pyramid_of,
)
from ldo_service.tracking.features import FeatureConfig
from ldo_service.tracking.keyframe_database import (
    KeyframeDatabaseConfig,
    KeyframeRecord,
    make_keyframe_record,
)
from ldo_service.tracking.keyframes import KeyframeConfig, ReferenceKeyframe
from ldo_service.tracking.map_frame import MapCorrection
from ldo_service.tracking.relocalization import (
    KeyframeReuse,
    KeyframeReuseConfig,
    find_nearby_keyframes,
)
from ldo_service.tracking.state import KeyframeOrigin
from ldo_service.tracking.tracking_quality import ResidualHistory, TrackingQualityConfig
from ldo_service.tracking.tracking_result import KeyframeKind

SOON = OdometryConfig(returning=KeyframeReuseConfig(after=1))


def moved(x_m: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    return se3.exp(np.array([0.0, turn_rad, 0.0, x_m, 0.0, 0.0]))


def place_at(room, number: int) -> KeyframeRecord:
    keyframe = ReferenceKeyframe(
        pyramid_of(room.view(np.eye(4)), PyramidConfig()), np.eye(4), number
    )
    return replace(
        make_keyframe_record(keyframe, FeatureConfig(), KeyframeDatabaseConfig()),
        median_depth_m=2.0,
    )


def correction_of(T_map_keyframe: Mapping[int, np.ndarray]) -> MapCorrection:
    return MapCorrection(1, {}, lambda _: T_map_keyframe)


def connect(odometry: Odometry) -> None:
    """Let the reference count as measured from a known keyframe, as one keyframe more would."""
    frames = odometry._frames
    frames.state = replace(frames.state, origin=KeyframeOrigin.TIED)


def followed(
    odometry: Odometry, room, poses: list[np.ndarray]
) -> tuple[list[TrackingResult], dict[int, np.ndarray]]:
    """Track along the poses; also the true T_odom_keyframe [4, 4] of the keyframes made."""
    results, made = [], {}
    for index, T in enumerate(poses):
        results.append(odometry.process(room.view(T, index=index)))
        if results[-1].keyframe is not None:
            made[results[-1].keyframe.id] = T
    return results, made


# --- which are near -------------------------------------------------------------------------------
def test_places_are_near_until_a_keyframe_is_due_the_nearest_first(room) -> None:
    config = KeyframeConfig(max_translation=0.1, max_rotation_rad=0.2)  # 0.2 m of 2 m
    places = [place_at(room, number) for number in range(5)]
    T_map = {0: moved(0.19), 1: moved(0.21), 2: moved(-0.05), 3: moved(0, 0.15), 4: moved(0, -0.25)}
    near = find_nearby_keyframes(places, T_map, np.eye(4), config)
    assert [place.id for place, _ in near] == [2, 3, 0]
    for place, T_place_camera in near:
        np.testing.assert_allclose(T_map[place.id] @ T_place_camera, np.eye(4), atol=1e-12)


def test_places_that_the_map_does_not_have_are_left_out(room) -> None:
    places = [place_at(room, number) for number in range(2)]
    assert [
        p.id for p, _ in find_nearby_keyframes(places, {1: np.eye(4)}, np.eye(4), KeyframeConfig())
    ] == [1]
    assert find_nearby_keyframes(places, {}, np.eye(4), KeyframeConfig()) == []


def due_on_the_way_back(
    odometry: Odometry, room, there: list[np.ndarray]
) -> tuple[TrackingResult, np.ndarray]:
    """Return the first frame that needs a new reference, and its true pose."""
    for T in reversed(there[:-1]):
        result = odometry.process(room.view(T), may_map=False)
        if result.denied_keyframe is KeyframeKind.REFERENCE:
            return result, T
    raise AssertionError("no keyframe was due")


# --- odometry -------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Back:
    """A camera that came back to where a keyframe is due, in a map that has the known ones."""

    odometry: Odometry
    correction: MapCorrection
    otherwise: TrackingResult  # Of the same frame without a map.
    result: TrackingResult


def left_and_back(room, make_walk, T_error: np.ndarray) -> Back:
    """There and back to where a keyframe is due, in a map that is off by T_error."""
    odometry, alone, there = Odometry(SOON), Odometry(SOON), make_walk(20)
    _, T_map = followed(odometry, room, there)
    due, T = due_on_the_way_back(odometry, room, there)
    alone.restore(odometry.snapshot())
    assert due.reference is not None
    T_map[due.reference] = T @ T_error @ se3.inverse(due.T_reference_camera)
    correction = correction_of(T_map)
    assert odometry.correct(correction)
    connect(odometry)
    frame = room.view(T)
    otherwise = alone.process(frame, may_map=False)
    return Back(odometry, correction, otherwise, odometry.process(frame, may_map=False))


def test_odometry_goes_on_where_it_is_against_the_known_keyframe(room, make_walk) -> None:
    back = left_and_back(room, make_walk, np.eye(4))
    returned, otherwise = back.result, back.otherwise
    assert otherwise.denied_keyframe is KeyframeKind.REFERENCE
    assert returned.reused_keyframe is not None
    assert returned.reference == returned.reused_keyframe == back.odometry.reference
    assert returned.reference != otherwise.reference
    assert (returned.status, returned.pose_source) == (TrackingStatus.OK, "reused")
    assert (returned.keyframe, returned.denied_keyframe) == (None, None)
    np.testing.assert_array_equal(returned.T_odom_camera, otherwise.T_odom_camera)
    again = back.odometry.process(room.view(returned.T_odom_camera))
    assert (again.reference, again.keyframe) == (returned.reference, None)
    np.testing.assert_allclose(again.T_odom_camera, returned.T_odom_camera, atol=3e-3)


def test_what_a_known_keyframe_shows_is_not_mapped_again(room, make_walk) -> None:
    back = left_and_back(room, make_walk, np.eye(4))
    odometry, returned = back.odometry, back.result
    step = se3.exp(np.array([0, 0.1, 0, 0, 0, 0]))  # worth mapping, but for that
    tracked = odometry.process(room.view(returned.T_odom_camera @ step), may_map=False)
    assert tracked.reference == returned.reference
    assert tracked.status is TrackingStatus.OK
    assert tracked.denied_keyframe in (None, KeyframeKind.REFERENCE)
    aside = tracked.T_odom_camera @ moved(turn_rad=0.3)  # where no known keyframe is
    for T in (aside, aside):
        made = odometry.process(room.view(T))
    assert odometry.reference is not None
    assert odometry.reference > max(back.correction.read_poses(None))
    ahead = odometry.process(room.view(made.T_odom_camera @ step))
    assert ahead.keyframe is not None, "of a new keyframe it is mapped"


def test_nobody_returns_where_map_and_images_disagree(room, make_walk) -> None:
    back = left_and_back(room, make_walk, moved(turn_rad=0.06))
    assert back.result.reused_keyframe is None
    assert back.result.denied_keyframe is KeyframeKind.REFERENCE


def test_nobody_returns_before_a_keyframe_is_measured_from_a_known_one(room, make_walk) -> None:
    odometry, there = Odometry(SOON), make_walk(20)
    _, T_map = followed(odometry, room, there)
    due, T = due_on_the_way_back(odometry, room, there)
    odometry.correct(correction_of(T_map))
    result = odometry.process(room.view(T))
    assert (result.reused_keyframe, result.reference) == (None, due.reference)
    assert result.keyframe is not None
    assert result.keyframe.kind is KeyframeKind.REFERENCE
    first, *others = result.keyframe.window
    assert first.a not in {other.a for other in others}
    T_true = se3.inverse(T_map[first.a]) @ T
    np.testing.assert_allclose(first.T_a_b, T_true, atol=5e-3)
    assert odometry._is_connected_to_map


def test_nobody_returns_to_what_looks_otherwise_now(room) -> None:
    reuse = KeyframeReuse(
        PyramidConfig(),
        AlignConfig(),
        KeyframeConfig(),
        TrackingQualityConfig(),
        KeyframeReuseConfig(),
    )
    near = [(place_at(room, 0), np.eye(4))]
    blank, same = (pyramid_of(f, PyramidConfig()) for f in (room.blank(), room.view(np.eye(4))))
    assert reuse.find(blank, near, ResidualHistory()) is None
    assert reuse.find(same, near, ResidualHistory()) is not None


def test_the_next_frames_after_a_return_survive_a_restart_bit_for_bit(room, make_walk) -> None:
    back = left_and_back(room, make_walk, np.eye(4))
    odometry, successor = back.odometry, Odometry(SOON)
    assert back.result.reused_keyframe is not None
    state = decode_state(encode_state(odometry.snapshot()))
    successor.restore(state, back.correction)
    for step in (0.01, 0.03, 0.06):
        view = room.view(back.result.T_odom_camera @ moved(step))
        a, b = odometry.process(view), successor.process(view)
        assert a.T_odom_camera.tobytes() == b.T_odom_camera.tobytes()
        assert a.T_map_odom.tobytes() == b.T_map_odom.tobytes()
        assert (a.reference, a.reused_keyframe) == (b.reference, b.reused_keyframe)
        assert (a.keyframe is None) == (b.keyframe is None)


def test_a_keyframe_made_after_a_return_is_measured_from_those_returned_to(room, make_walk) -> None:
    """Odometry has them elsewhere than before, as after a long way, and the window must know."""
    odometry, there = Odometry(SOON), make_walk(45)
    _, T_map = followed(odometry, room, there)
    state = odometry._frames.state
    far = tuple(
        replace(p, T_odom_keyframe=moved(0.4) @ p.T_odom_keyframe) for p in state.places.all
    )
    odometry._frames.state = replace(state, places=replace(state.places, all=far))
    odometry.correct(correction_of(T_map))
    connect(odometry)
    back = [odometry.process(room.view(T)) for T in reversed(there[:-1])]
    assert [result.keyframe for result in back] == [None] * len(back)
    seen = {result.reused_keyframe for result in back if result.reused_keyframe is not None}
    assert len(seen) > 2
    aside = room.view(there[0] @ moved(turn_rad=0.3))
    for _ in range(2):
        result = odometry.process(aside)
        if result.keyframe is not None:
            break
    assert result.keyframe is not None
    assert result.keyframe.kind is KeyframeKind.REFERENCE
    window = result.keyframe.window
    assert {measured.a for measured in window} <= seen
    assert window
    for measured in window:
        assert measured.b == result.keyframe.id
        T_true = se3.inverse(T_map[measured.a]) @ there[0] @ moved(turn_rad=0.3)
        np.testing.assert_allclose(measured.T_a_b, T_true, atol=1e-2)


@pytest.mark.parametrize(
    "wrong",
    [{"after": -1}, {"tries": 0}, {"agreement_rad": 0.0}, {"min_geometric_inliers": 1.5}],
)
def test_settings_that_cannot_be_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        KeyframeReuseConfig(**wrong)


def test_a_camera_that_moves_slowly_stays_with_the_keyframe_it_returned_to(room, make_walk) -> None:
    """A new one is due after so many frames; an old one shows the same after a year."""
    back = left_and_back(room, make_walk, np.eye(4))
    assert back.result.reused_keyframe is not None
    steps = [back.result.T_odom_camera @ moved(5e-4 * k, 2e-3 * (k % 2)) for k in range(40)]
    results, made = followed(back.odometry, room, steps)
    assert made == {}
    assert {result.reference for result in results} == {back.result.reference}


def test_what_was_put_there_since_then_is_not_taken_for_something_that_moves(
    room, make_walk
) -> None:
    back = left_and_back(room, make_walk, np.eye(4))
    assert back.result.reused_keyframe is not None
    tracked = back.odometry.process(with_a_box(room.view(back.result.T_odom_camera)))
    assert tracked.status is TrackingStatus.OK
    assert tracked.reference == back.result.reference
    assert tracked.dynamic_mask is None


def test_of_a_new_keyframe_something_that_comes_is_taken_to_move(room) -> None:
    odometry = Odometry(SOON)
    odometry.process(room.view(np.eye(4)))
    tracked = odometry.process(with_a_box(room.view(np.eye(4))))
    assert tracked.dynamic_mask is not None
    assert tracked.dynamic_mask[55, 75]


def with_a_box(frame: RgbdFrame) -> RgbdFrame:
    color, depth_m = frame.color.copy(), frame.depth_m.copy()
    color[40:70, 60:90] = np.random.default_rng(0).integers(60, 200, (30, 30, 1))
    depth_m[40:70, 60:90] = 1.0
    return replace(frame, color=color, depth_m=depth_m)


def test_whom_a_detector_found_is_not_in_the_place_either(room) -> None:
    odometry = Odometry(SOON)
    frame = room.view(np.eye(4))
    number = odometry.process(frame).reference
    assert number is not None
    before = odometry._frames.state.places.all[0]
    odometry.mask_dynamic_objects(number, [Box("person", 40.0, 30.0, 90.0, 100.0)])
    (after,) = odometry._frames.state.places.all
    assert np.count_nonzero(before.depth_m[50:80, 50:80]) > 800
    assert np.count_nonzero(after.depth_m[50:80, 50:80]) < 300


def test_a_lost_camera_that_is_found_again_maps_nothing_anew(room, make_walk) -> None:
    odometry, there = Odometry(SOON), make_walk(60)
    followed(odometry, room, there)
    odometry.process(room.blank())
    found = odometry.process(room.view(there[2]), may_map=False)
    assert (found.status, found.pose_source) == (TrackingStatus.OK, "relocalized")
    assert found.denied_keyframe in (None, KeyframeKind.REFERENCE)
    assert odometry._is_connected_to_map


@pytest.mark.parametrize(("after", "may"), [(0, False), (3, False), (2, True)])
def test_known_keyframes_do_once_there_are_many(room, after: int, may: bool) -> None:
    each_frame = KeyframeConfig(min_frames=1, max_frames=1, still_motion=0.0)
    config = OdometryConfig(returning=KeyframeReuseConfig(after=after), keyframes=each_frame)
    odometry = Odometry(config)
    _, made = followed(odometry, room, [moved(0.02 * number) for number in range(2)])
    assert len(made) == 2
    assert odometry._frames.can_reuse_keyframes is may
