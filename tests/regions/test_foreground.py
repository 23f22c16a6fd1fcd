import doctest
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.regions import foreground as foreground_module
from ldo_service.regions.foreground import (
    ForegroundConfig,
    SmoothSurfaces,
    foreground,
    pixels_of,
    surfaces,
)
from tests.reference import foreground as reference

CAMERA, CONFIG = Camera(160, 120, 140.0, 140.0, 79.5, 59.5), ForegroundConfig()
OBJECT = slice(50, 90), slice(60, 100)


def room_depth(noise: float = 0.0) -> np.ndarray:
    """Return depth of a wall at 3 m, a floor 1 m below the camera and an object at 1.5 m."""
    down = (np.arange(120) - CAMERA.cy) / CAMERA.fy
    floor_m = np.where(down > 0, 1 / np.maximum(down, 1e-6), np.inf)
    depth_m = np.tile(np.minimum(floor_m, 3.0)[:, None], (1, 160))
    depth_m[OBJECT] = 1.5
    depth_m *= 1 + noise * np.random.default_rng(0).normal(size=depth_m.shape)
    return depth_m.astype(np.float32)


def foreground_mask(depth_m: np.ndarray, box: list[float]) -> np.ndarray:
    pieces = surfaces(depth_m, CAMERA, CONFIG)
    part = foreground(np.array(box), depth_m, pieces, CAMERA, CONFIG)
    return part.image(depth_m.shape)


def object_mask() -> np.ndarray:
    out = np.zeros((120, 160), bool)
    out[OBJECT] = True
    return out


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(foreground_module).failed == 0
    assert doctest.testmod(reference).failed == 0


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("margin", [0.5, 8, 15])
def test_object_is_separated_from_wall_and_floor_for_any_box_margin(noise, margin) -> None:
    mask = foreground_mask(room_depth(noise), [60 - margin, 50 - margin, 99 + margin, 89 + margin])
    agreement = np.count_nonzero(mask & object_mask()) / np.count_nonzero(mask | object_mask())
    assert agreement > 0.9


def test_box_on_a_bare_wall_has_no_foreground() -> None:
    assert not foreground_mask(room_depth(), [5, 5, 40, 40]).any()


def test_missing_depth_gives_no_foreground() -> None:
    depth_m = room_depth()
    depth_m[45:95, 55:105] = 0
    assert not foreground_mask(depth_m, [55, 45, 104, 94]).any()
    assert not foreground_mask(np.zeros_like(depth_m), [55, 45, 104, 94]).any()


@pytest.mark.parametrize("box", [[-50, -50, -10, -10], [70, 60, 70.2, 60.2], [0, 0, 400, 400]])
def test_boxes_outside_the_image_or_between_pixels_are_valid(box) -> None:
    assert foreground_mask(room_depth(), box).shape == (120, 160)


def test_pixels_of_box_are_those_with_centers_inside() -> None:
    assert pixels_of(np.array([0.5, -3, 2, 1.4]), (4, 6)) == (slice(0, 2), slice(1, 3))
    assert pixels_of(np.array([9, 9, 12, 12]), (4, 6)) == (slice(4, 4), slice(6, 6))


def test_foreground_is_the_dominant_depth_not_the_nearest() -> None:
    depth_m, near = room_depth(), (slice(64, 76), slice(74, 86))
    depth_m[near] = 0.8
    arguments = np.array([60, 50, 99, 89]), depth_m, edges_only(depth_m), CAMERA, CONFIG
    mask = foreground(*arguments).image(depth_m.shape)
    assert not mask[near].any()
    assert np.mean(mask[OBJECT]) > 0.8


def edges_only(depth_m: np.ndarray) -> SmoothSurfaces:
    """Return surfaces without any smooth pixel: all pixels lie on edges."""
    return SmoothSurfaces(np.zeros(depth_m.shape, np.int32), np.array([depth_m.size]))


@pytest.mark.parametrize("settings", [{"min_cosine": 1.5}, {"depth_bin": 0}, {"grow_px": -1}])
def test_settings_out_of_range_raise_config_error(settings) -> None:
    with pytest.raises(ConfigError):
        ForegroundConfig(**settings)


def test_mismatched_surfaces_and_images_raise() -> None:
    depth_m, box = room_depth(), np.array([5, 5, 40, 40])
    with pytest.raises(ValueError, match="shape"):
        surfaces(depth_m[:-1], CAMERA, CONFIG)
    with pytest.raises(ValueError, match="shape"):
        foreground(box, depth_m[:-1], edges_only(depth_m), CAMERA, CONFIG)
    unknown = SmoothSurfaces(np.full(depth_m.shape, 7, np.int32), np.array([depth_m.size]))
    with pytest.raises(ValueError, match="each label must be"):
        foreground(box, depth_m, unknown, CAMERA, CONFIG)


@pytest.mark.parametrize("name", ["tum/kitchen", "replica/apartment_floor1"])
def test_kernel_matches_reference_on_real_frames(data: Path, name: str) -> None:
    sequence = open_sequence(str(data / name))
    for index in (0, 40, 80):
        frame = sequence[index]
        height, width = frame.depth_m.shape
        actual = surfaces(frame.depth_m, frame.camera, CONFIG)
        reference_surfaces = reference.surfaces_reference(frame.depth_m, frame.camera, CONFIG)
        # Cosines at the threshold may differ.
        assert np.mean((actual.labels > 0) != (reference_surfaces.labels > 0)) < 1e-4
        np.testing.assert_array_equal(actual.labels, components(actual.labels > 0))
        for low in np.random.default_rng(index).uniform(-20, [width, height], (20, 2)):
            box = np.concatenate([low, low + 0.3 * np.array([width, height])])
            arguments = box, frame.depth_m, reference_surfaces, frame.camera, CONFIG
            expected = reference.foreground_reference(*arguments).mask
            np.testing.assert_array_equal(foreground(*arguments).mask, expected)


def components(is_set: np.ndarray) -> np.ndarray:
    return cv2.connectedComponents(is_set.astype(np.uint8), connectivity=4)[1]
