import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry import Camera
from ldo_service.geometry.registration import resample_color
from tests.geometry.cameras import CAMERA, COARSER, COLOR_CAMERAS, FINER


def colored_by_ray(camera: Camera) -> np.ndarray:
    """Return an image with the ray directions in red and green."""
    rays = camera.rays()
    channels = [100 + 100 * rays[..., 0], 100 + 100 * rays[..., 1], np.zeros(rays.shape[:2])]
    return np.rint(np.stack(channels, -1)).astype(np.uint8)


@pytest.mark.parametrize("color_camera", COLOR_CAMERAS.values(), ids=COLOR_CAMERAS.keys())
def test_color_is_resampled_along_its_rays(color_camera: Camera) -> None:
    image, is_seen = resample_color(colored_by_ray(color_camera), color_camera, CAMERA)
    assert image.shape == (48, 64, 3)
    assert np.all(is_seen[1:-1, 1:-1])
    error = np.abs(image.astype(int) - colored_by_ray(CAMERA))[1:-1, 1:-1]
    assert error.max() <= (3 if color_camera is COARSER else 2)


def test_color_of_the_same_camera_is_untouched() -> None:
    color = np.random.default_rng(2).integers(0, 256, (48, 64, 3), np.uint8)
    image, is_seen = resample_color(color, CAMERA, CAMERA)
    assert np.array_equal(image, color)
    assert np.all(is_seen)


def test_fine_stripes_become_their_mean_and_no_moire() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    small = Camera(310, 236, 245.0, 245.0, 154.5, 117.5)
    stripes = np.zeros((480, 640, 3), np.uint8)
    stripes[:, ::2] = 200
    image, _ = resample_color(stripes, camera, small)
    assert np.all(np.abs(image[2:-2, 2:-2].astype(int) - 100) <= 1)


def test_pixels_outside_the_color_image_are_marked() -> None:
    wide = Camera(64, 48, 25.0, 25.0, 31.5, 23.5)
    narrow = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    _, is_seen = resample_color(colored_by_ray(narrow), narrow, wide)
    expected = np.zeros((48, 64), bool)
    expected[12:36, 16:48] = True
    assert np.array_equal(is_seen, expected)


def test_color_of_another_size_than_its_camera_is_an_error() -> None:
    with pytest.raises(FrameError, match="64x48 pixels, but its intrinsics are for 130x97"):
        resample_color(colored_by_ray(CAMERA), FINER, CAMERA)
