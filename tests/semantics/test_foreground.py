import doctest

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.semantics import foreground as foreground_module
from ldo_service.semantics.foreground import (
    ForegroundConfig,
    foreground,
    mode_of,
    pixels_of,
    surfaces,
)

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


def test_a_box_has_the_pixels_whose_centres_lie_in_it() -> None:
    assert pixels_of(np.array([0.5, -3, 2, 1.4]), (4, 6)) == (slice(0, 2), slice(1, 3))
    assert pixels_of(np.array([9, 9, 12, 12]), (4, 6)) == (slice(4, 4), slice(6, 6))


def test_mode_prefers_the_many_to_the_near() -> None:
    depth_m = np.array([0.8] * 5 + [2.0] * 20 + [2.1] * 15 + [0.0] * 90)
    assert mode_of(depth_m, 0.05) == pytest.approx(2.0, rel=0.06)


def test_settings_beyond_their_range_are_refused() -> None:
    with pytest.raises(ConfigError):
        ForegroundConfig(min_cosine=1.5)
