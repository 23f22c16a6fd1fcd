"""Tests of the positions and colors of the lines that the viewer draws."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.poses import pose_to_message
from ldo_service.geometry import Camera, se3
from ldo_service.schemas import MapObjects
from ldo_service.viewer.lines import (
    FRUSTUM_M,
    JUMP_M,
    MAX_DETECTIONS,
    box_lines,
    color_of,
    detection_lines,
    keyframe_lines,
    loop_lines,
    path_lines,
)
from ldo_service.viewer.scene import ObjectBox, thinned
from tests.schemas.examples import EXAMPLES

CAMERA = Camera(64, 48, 60.0, 50.0, 30.0, 25.0)
T_MAP_CAMERA = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0]))
WHITE = (255, 255, 255)


def project(points: np.ndarray) -> np.ndarray:
    """Return the pixels of points of the map in the camera."""
    return CAMERA.project(se3.transform(se3.inverse(T_MAP_CAMERA), points))


def test_frustum_of_a_keyframe_matches_its_camera() -> None:
    lines = keyframe_lines([T_MAP_CAMERA], CAMERA)
    assert lines.points.shape == lines.colors.shape == (8, 2, 3)
    rays, outline = lines.points[:4], lines.points[4:]
    np.testing.assert_allclose(rays[:, 0], np.tile(T_MAP_CAMERA[:3, 3], (4, 1)), atol=1e-6)
    corners = [(-0.5, -0.5), (63.5, -0.5), (63.5, 47.5), (-0.5, 47.5)]
    for drawn in (rays[:, 1], outline[:, 0]):
        np.testing.assert_allclose(project(drawn), corners, atol=1e-3)
    z_m = se3.transform(se3.inverse(T_MAP_CAMERA), outline)[..., 2]
    np.testing.assert_allclose(z_m, FRUSTUM_M, atol=1e-6)


def test_detection_is_drawn_at_the_pixels_of_its_box() -> None:
    boxes = {
        7: (ObjectBox("cup", (10.0, 5.0, 20.0, 15.0)), ObjectBox("sofa", (0.0, 0.0, 60.0, 40.0)))
    }
    lines = detection_lines({7: T_MAP_CAMERA, 8: np.eye(4)}, CAMERA, boxes)
    assert lines.points.shape == (8, 2, 3)
    corners = [(10, 5), (20, 5), (20, 15), (10, 15)]
    np.testing.assert_allclose(project(lines.points[:4, 0]), corners, atol=1e-3)
    np.testing.assert_allclose(lines.points[:4, 1], np.roll(lines.points[:4, 0], -1, axis=0))
    assert tuple(lines.colors[0, 0]) == color_of("cup")
    assert tuple(lines.colors[7, 1]) == color_of("sofa")


def test_detections_need_a_camera_and_are_bounded_in_number() -> None:
    boxes = {7: tuple(ObjectBox("cup", (i, 0.0, i + 1.0, 1.0)) for i in range(2 * MAX_DETECTIONS))}
    assert len(detection_lines({7: T_MAP_CAMERA}, None, boxes).points) == 0
    assert len(detection_lines({7: T_MAP_CAMERA}, CAMERA, boxes).points) == 4 * MAX_DETECTIONS
    assert len(detection_lines({}, CAMERA, boxes).points) == 0


def test_object_box_has_the_pose_size_and_color_of_its_object() -> None:
    example = EXAMPLES["map_objects"]
    assert isinstance(example, MapObjects)
    map_object = msgspec.structs.replace(
        example.objects[0], T_map_object=pose_to_message(T_MAP_CAMERA), size=(0.5, 0.25, 1.0)
    )
    lines = box_lines([map_object])
    lengths = np.linalg.norm(lines.points[:, 1] - lines.points[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), [0.25] * 4 + [0.5] * 4 + [1.0] * 4, atol=1e-6)
    p_object = se3.transform(se3.inverse(T_MAP_CAMERA), lines.points)
    corners = np.broadcast_to([0.25, 0.125, 0.5], (12, 2, 3))
    np.testing.assert_allclose(np.abs(p_object), corners, atol=1e-6)
    assert tuple(lines.colors[0, 0]) == color_of(map_object.name)
    assert tuple(box_lines([map_object], WHITE).colors[0, 0]) == WHITE
    assert len(box_lines([]).points) == 0


def test_path_has_gaps_at_jumps_and_unknown_positions() -> None:
    x = [0.0, 0.1, 0.2, 0.2 + 2 * JUMP_M, 0.3 + 2 * JUMP_M, np.nan, 0.5 + 2 * JUMP_M]
    path = np.stack([x, np.zeros(7), np.zeros(7)], axis=1)
    lines = path_lines(path, WHITE)
    np.testing.assert_allclose(
        lines.points[:, :, 0], [(0, 0.1), (0.1, 0.2), (x[3], x[4])], atol=1e-6
    )


def test_path_with_uniformly_long_steps_has_gaps_only_at_jumps() -> None:
    x = 2 * JUMP_M * np.arange(50.0)
    x[25:] += 100 * JUMP_M
    lines = path_lines(np.stack([x, 0 * x, 0 * x], axis=1), WHITE)
    assert len(lines.points) == 48


@pytest.mark.parametrize("poses", [0, 1])
def test_path_with_fewer_than_two_poses_has_no_lines(poses: int) -> None:
    assert path_lines(np.zeros((poses, 3)), WHITE).points.shape == (0, 2, 3)


def test_loop_is_drawn_only_between_known_keyframes() -> None:
    keyframes = {3: np.eye(4), 9: T_MAP_CAMERA}
    lines = loop_lines([(3, 9), (3, 10), (2, 9)], keyframes)
    np.testing.assert_allclose(lines.points, [[np.zeros(3), T_MAP_CAMERA[:3, 3]]], atol=1e-6)


def test_each_name_has_its_own_constant_color() -> None:
    names = ("chair", "couch", "cup", "oven", "bed", "clock")
    assert len({color_of(name) for name in names}) == len(names)
    assert color_of("chair") == color_of("chair")


@pytest.mark.parametrize(("count", "expected"), [(0, 0), (5, 5), (10, 10), (11, 6), (25, 9)])
def test_thinning_is_even_and_bounded(count: int, expected: int) -> None:
    values = thinned(np.arange(count), 10)
    assert len(values) == expected
    assert len(set(np.diff(values))) <= 1


def test_shorter_focal_length_draws_a_wider_frustum() -> None:
    wide = replace(CAMERA, fx=30.0)
    narrow, wider = (keyframe_lines([np.eye(4)], camera).points for camera in (CAMERA, wide))
    assert np.ptp(wider[4:, 0, 0]) == pytest.approx(2 * np.ptp(narrow[4:, 0, 0]), rel=1e-5)
