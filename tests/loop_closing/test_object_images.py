"""Images of an object in two keyframes, compared at a relative pose."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.loop_closing.object_images import (
    ImageComparison,
    PosedImage,
    compare_images,
    smoothed,
)

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
WALL_M = 2.0
CENTER_M = np.array([0.0, 0.0, WALL_M])
POSTER = np.diag([0.03, 0.03, 0.0])  # Covariance of a flat poster, 0.6 m wide.


def wall(x_m: float = 0.0, turn_rad: float = 0.0, z_m: float = 0.0) -> PosedImage:
    """Return the image of a wall with a pattern of waves, from a camera at x and z."""
    T_map_camera = np.eye(4)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    T_map_camera[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T_map_camera[:3, 3] = x_m, 0, z_m
    rays = CAMERA.rays() @ T_map_camera[:3, :3].T
    depth_m = (WALL_M - z_m) / rays[..., 2]
    x, y = rays[..., 0] * depth_m + x_m, rays[..., 1] * depth_m
    gray = smoothed((128 + 50 * np.sin(14 * x + 3) * np.cos(11 * y)).astype(np.uint8))
    return PosedImage(gray, depth_m.astype(np.float32), CAMERA, T_map_camera)


def compare(first: PosedImage, second: PosedImage) -> ImageComparison:
    found = compare_images(CENTER_M, POSTER, first, second)
    assert found is not None
    return found


@pytest.mark.parametrize(("x_m", "turn_rad"), [(0.0, 0.0), (0.3, -0.1), (-0.5, 0.2)])
def test_images_of_one_object_correlate_from_two_viewpoints(x_m: float, turn_rad: float) -> None:
    found = compare(wall(), wall(x_m, turn_rad))
    assert found.correlation > 0.97
    assert 15 < found.contrast < 50


def test_images_do_not_correlate_at_a_wrong_pose() -> None:
    """The pose is wrong by half a wave."""
    T_wrong = np.eye(4)
    T_wrong[0, 3] = np.pi / 14
    assert compare(wall(), replace(wall(), T_map_camera=T_wrong)).correlation < -0.9


def test_exposure_does_not_change_the_correlation() -> None:
    dark = wall(0.3)
    assert compare(wall(), replace(dark, gray=0.4 * dark.gray + 5)).correlation > 0.97


def test_bare_wall_does_not_correlate_with_a_poster() -> None:
    noise = np.random.default_rng(0).normal(128, 3, (CAMERA.height, CAMERA.width))
    bare = replace(wall(0.2), gray=noise.astype(np.float32))
    assert abs(compare(wall(), bare).correlation) < 0.2
    assert compare(bare, wall()).contrast < 4


def test_hidden_small_and_outside_objects_are_not_compared() -> None:
    here = wall()
    near = replace(here, depth_m=np.full_like(here.depth_m, 1.0))
    unmeasured = replace(here, depth_m=np.zeros_like(here.depth_m))
    assert compare_images(CENTER_M, POSTER, here, near) is None
    assert compare_images(CENTER_M, POSTER, unmeasured, here) is None
    assert compare_images(CENTER_M, 1e-6 * POSTER, here, here) is None
    assert compare_images(CENTER_M + np.array([5.0, 0.0, 0.0]), POSTER, here, here) is None
    assert compare_images(-CENTER_M, POSTER, here, here) is None


def test_object_with_few_different_pixels_in_one_image_is_not_compared() -> None:
    """A poster of 0.2 m is 15 pixels wide from 2 m, and 3 pixels wide from 10 m."""
    small = np.diag([0.0033, 0.0033, 0.0])
    near, far = wall(), wall(z_m=-8.0)
    assert compare_images(CENTER_M, small, near, near) is not None
    assert compare_images(CENTER_M, small, near, far) is None
    assert compare_images(CENTER_M, small, far, near) is None
    tiny = small / 6  # 8 pixels wide, of which fewer than 50 are on the object.
    assert compare_images(CENTER_M, tiny, near, near) is None


def test_ignored_pixels_are_left_out() -> None:
    """Half of the object is overexposed in the second image, where ignored pixels are 0."""
    there = np.full((CAMERA.height, CAMERA.width), 100, np.uint8)
    there[:, CAMERA.width // 2 :] = 0
    assert np.isnan(smoothed(there)[:, CAMERA.width // 2 - 1 :]).all()
    assert np.isfinite(smoothed(there)[:, : CAMERA.width // 2 - 1]).all()
    half = np.where(np.isnan(smoothed(there)), np.nan, wall(0.3).gray)
    assert compare(wall(), replace(wall(0.3), gray=half)).correlation > 0.97
    nothing = np.full_like(half, np.nan)
    assert compare_images(CENTER_M, POSTER, wall(), replace(wall(), gray=nothing)) is None
