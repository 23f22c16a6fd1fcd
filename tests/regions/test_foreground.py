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
from tests.reference import foreground as twin

CAMERA, CONFIG = Camera(160, 120, 140.0, 140.0, 79.5, 59.5), ForegroundConfig()
CUBE = slice(50, 90), slice(60, 100)


def room(noise: float = 0.0) -> np.ndarray:
    """A wall at 3 m, a floor 1 m below the camera, and a thing at 1.5 m that stands before both."""
    down = (np.arange(120) - CAMERA.cy) / CAMERA.fy
    floor_m = np.where(down > 0, 1 / np.maximum(down, 1e-6), np.inf)
    depth_m = np.tile(np.minimum(floor_m, 3.0)[:, None], (1, 160))
    depth_m[CUBE] = 1.5
    depth_m *= 1 + noise * np.random.default_rng(0).normal(size=depth_m.shape)
    return depth_m.astype(np.float32)


def found(depth_m: np.ndarray, box: list[float]) -> np.ndarray:
    pieces = surfaces(depth_m, CAMERA, CONFIG)
    part = foreground(np.array(box), depth_m, pieces, CAMERA, CONFIG)
    return part.image(depth_m.shape)


def thing() -> np.ndarray:
    out = np.zeros((120, 160), bool)
    out[CUBE] = True
    return out


def test_examples_in_the_docstrings_hold() -> None:
    assert doctest.testmod(foreground_module).failed == 0
    assert doctest.testmod(twin).failed == 0


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("margin", [0.5, 8, 15])
def test_a_thing_is_cut_from_wall_and_floor_however_loose_its_box(noise, margin) -> None:
    got = found(room(noise), [60 - margin, 50 - margin, 99 + margin, 89 + margin])
    agreement = np.count_nonzero(got & thing()) / np.count_nonzero(got | thing())
    assert agreement > 0.9


def test_a_box_on_a_bare_wall_holds_nothing() -> None:
    assert not found(room(), [5, 5, 40, 40]).any()


def test_without_depth_there_is_no_foreground() -> None:
    depth_m = room()
    depth_m[45:95, 55:105] = 0
    assert not found(depth_m, [55, 45, 104, 94]).any()
    assert not found(np.zeros_like(depth_m), [55, 45, 104, 94]).any()


@pytest.mark.parametrize("box", [[-50, -50, -10, -10], [70, 60, 70.2, 60.2], [0, 0, 400, 400]])
def test_boxes_beyond_the_image_and_between_pixels_do_no_harm(box) -> None:
    assert found(room(), box).shape == (120, 160)


def test_a_box_has_the_pixels_whose_centers_lie_in_it() -> None:
    assert pixels_of(np.array([0.5, -3, 2, 1.4]), (4, 6)) == (slice(0, 2), slice(1, 3))
    assert pixels_of(np.array([9, 9, 12, 12]), (4, 6)) == (slice(4, 4), slice(6, 6))


def test_the_many_pixels_in_the_middle_are_the_thing_and_not_the_near_ones() -> None:
    depth_m, near = room(), (slice(64, 76), slice(74, 86))
    depth_m[near] = 0.8
    told = np.array([60, 50, 99, 89]), depth_m, one_piece(depth_m), CAMERA, CONFIG
    found = foreground(*told).image(depth_m.shape)
    assert not found[near].any()
    assert np.mean(found[CUBE]) > 0.8


def one_piece(depth_m: np.ndarray) -> SmoothSurfaces:
    """All on edges."""
    return SmoothSurfaces(np.zeros(depth_m.shape, np.int32), np.array([depth_m.size]))


@pytest.mark.parametrize("settings", [{"min_cosine": 1.5}, {"depth_bin": 0}, {"grow_px": -1}])
def test_settings_beyond_their_range_are_refused(settings) -> None:
    with pytest.raises(ConfigError):
        ForegroundConfig(**settings)


def test_surfaces_and_images_that_do_not_fit_are_refused() -> None:
    depth_m, box = room(), np.array([5, 5, 40, 40])
    with pytest.raises(ValueError, match="shape"):
        surfaces(depth_m[:-1], CAMERA, CONFIG)
    with pytest.raises(ValueError, match="shape"):
        foreground(box, depth_m[:-1], one_piece(depth_m), CAMERA, CONFIG)
    unknown = SmoothSurfaces(np.full(depth_m.shape, 7, np.int32), np.array([depth_m.size]))
    with pytest.raises(ValueError, match="labels"):
        foreground(box, depth_m, unknown, CAMERA, CONFIG)


@pytest.mark.parametrize("name", ["tum/kitchen", "replica/apartment_floor1"])
def test_kernel_does_on_real_frames_what_its_twin_does(data: Path, name: str) -> None:
    sequence = open_sequence(str(data / name))
    for index in (0, 40, 80):
        frame = sequence[index]
        height, width = frame.depth_m.shape
        ours = surfaces(frame.depth_m, frame.camera, CONFIG)
        plain = twin.surfaces_reference(frame.depth_m, frame.camera, CONFIG)
        assert np.mean((ours.labels > 0) != (plain.labels > 0)) < 1e-4  # cosines at the threshold
        np.testing.assert_array_equal(ours.labels, components(ours.labels > 0))
        for low in np.random.default_rng(index).uniform(-20, [width, height], (20, 2)):
            box = np.concatenate([low, low + 0.3 * np.array([width, height])])
            told = box, frame.depth_m, plain, frame.camera, CONFIG
            wanted = twin.foreground_reference(*told).mask
            np.testing.assert_array_equal(foreground(*told).mask, wanted)


def components(is_set: np.ndarray) -> np.ndarray:
    return cv2.connectedComponents(is_set.astype(np.uint8), connectivity=4)[1]
