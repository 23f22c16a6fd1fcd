"""Tests of the views of objects and of the flights between views."""

import itertools

import msgspec
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.geometry import se3
from ldo_service.schemas import MapObject, MapObjects, ObjectView, Pose
from ldo_service.viewer.flight import (
    NEAREST_M,
    CameraView,
    estimate_up,
    interpolate_views,
    overview,
    view_of,
)
from tests.schemas.examples import EXAMPLES

EXAMPLE_OBJECTS = EXAMPLES["map_objects"]
assert isinstance(EXAMPLE_OBJECTS, MapObjects)
HALF_VIEW_RAD = np.deg2rad(75) / 2  # Half the field of view that viser gives the browser.


def object_of_size(size: tuple[float, float, float], *keyframes: int) -> MapObject:
    views = tuple(ObjectView(keyframe=k, box_px=(0.0, 0.0, 1.0, 1.0)) for k in keyframes)
    return msgspec.structs.replace(
        EXAMPLE_OBJECTS.objects[0],
        T_map_object=Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)),
        size=size,
        views=views,
    )


def pose_at(*position: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = position
    return T


@pytest.mark.parametrize("size", [(0.1, 0.1, 0.1), (0.5, 2.0, 1.0), (3.0, 1.0, 0.1)])
def test_view_contains_the_whole_object(size: tuple[float, float, float]) -> None:
    map_object = object_of_size(size)
    view = view_of(map_object, {}, np.array([5.0, 2.0, -3.0]))
    corners = view.look_at + 0.5 * np.array(list(itertools.product((-1, 1), repeat=3))) * size
    corner_rays, axis = corners - view.position, view.look_at - view.position
    cosines = corner_rays @ axis / np.linalg.norm(corner_rays, axis=1) / np.linalg.norm(axis)
    assert np.arccos(cosines.min()) < HALF_VIEW_RAD
    assert np.linalg.norm(axis) >= NEAREST_M - 1e-9


def test_view_is_from_the_first_known_keyframe_that_shows_the_object() -> None:
    keyframes = {4: pose_at(1, 2, 13), 5: pose_at(11, 2, 3)}
    view = view_of(object_of_size((0.2, 0.2, 0.2), 9, 5, 4), keyframes, np.zeros(3))
    np.testing.assert_allclose(view.look_at, [1, 2, 3])
    assert view.position[0] > 1
    np.testing.assert_allclose(view.position[1:], [2, 3])


def test_view_is_not_behind_the_observing_keyframe() -> None:
    """The space behind the keyframe is unobserved and may hold a wall."""
    keyframe = pose_at(1, 2, 4)
    view = view_of(object_of_size((2.0, 2.0, 2.0), 5), {5: keyframe}, np.zeros(3))
    np.testing.assert_allclose(view.position, keyframe[:3, 3])


def test_view_from_inside_the_object_moves_to_the_minimum_distance() -> None:
    view = view_of(object_of_size((0.2, 0.2, 0.2)), {}, np.array([1.0, 2.0, 3.0]))
    assert np.linalg.norm(view.position - view.look_at) >= NEAREST_M - 1e-9


def test_flight_starts_and_ends_slowly_and_reaches_the_end_view() -> None:
    start, end = CameraView(np.zeros(3), np.ones(3)), CameraView(np.array([4.0, 0, 0]), np.zeros(3))
    views = list(interpolate_views(start, end, 20))
    x = np.array([0.0, *(view.position[0] for view in views)])
    steps = np.diff(x)
    assert len(views) == 20
    assert (steps > 0).all()
    assert steps[0] < 0.5 * steps[10]
    assert steps[-1] < 0.5 * steps[10]
    np.testing.assert_array_equal(views[-1].position, end.position)
    np.testing.assert_array_equal(views[-1].look_at, end.look_at)


def test_overview_is_behind_the_camera_and_looks_along_its_axis() -> None:
    T = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0]))
    view = overview(T)
    p_camera_position, p_camera_target = (
        se3.transform(se3.inverse(T), point) for point in (view.position, view.look_at)
    )
    assert p_camera_position[2] < 0 < p_camera_target[2]
    np.testing.assert_allclose([*p_camera_position[:2], *p_camera_target[:2]], 0, atol=1e-9)


@pytest.mark.parametrize("name", ["flat", "tour", "room"])
def test_estimated_up_is_the_vertical_of_the_world(name: str) -> None:
    """The vertical is the z axis of the synthetic world, however the first camera is oriented."""
    truth = open_sequence(f"synthetic:{name}").truth()
    assert truth is not None
    T_first = truth.T_world_camera[0]
    T_map_camera = se3.inverse(T_first) @ truth.T_world_camera
    up = estimate_up(dict(enumerate(T_map_camera)))
    true_up = T_first[2, :3]  # z of the world in the frame of the first camera.
    assert np.rad2deg(np.arccos(up @ true_up)) < 5


def test_up_without_keyframes_is_that_of_a_level_camera() -> None:
    np.testing.assert_array_equal(estimate_up({}), [0, -1, 0])
