import cv2
import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.geometry.camera import project, rays
from tests.geometry.cameras import FREIBURG1

AZURE_KINECT = (0.52, -2.71, 0.0009, -0.0002, 1.56, 0.40, -2.53, 1.49)
LENSES = [(), (-0.1, 0.08, 0.002, -0.001), FREIBURG1, AZURE_KINECT]


def camera(distortion: tuple[float, ...]) -> Camera:
    return Camera(160, 120, 130.0, 131.0, 78.0, 61.0, distortion)


@pytest.mark.parametrize("distortion", LENSES)
def test_projection_agrees_with_opencv(distortion: tuple[float, ...]) -> None:
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 2)).astype(np.float32)
    u, v = project(xy[:, 0], xy[:, 1], camera(distortion))
    points, zero = np.c_[xy, np.ones(500)].astype(float), np.zeros(3)
    expected = cv2.projectPoints(
        points, zero, zero, camera(()).matrix, np.array(distortion or [0.0] * 4)
    )
    np.testing.assert_allclose(np.c_[u, v], expected[0][:, 0], atol=1e-3)


@pytest.mark.parametrize("distortion", LENSES)
def test_rays_project_to_their_pixels(distortion: tuple[float, ...]) -> None:
    u, v = project(*rays(camera(distortion)), camera(distortion))
    expected_u, expected_v = np.meshgrid(np.arange(160), np.arange(120))
    np.testing.assert_allclose(u, expected_u, atol=0.1)
    np.testing.assert_allclose(v, expected_v, atol=0.1)


def test_rays_are_shared_and_cannot_be_written_to() -> None:
    x, y = rays(camera(FREIBURG1))
    assert x is rays(camera(FREIBURG1))[0]
    for image in (x, y):
        with pytest.raises(ValueError, match="read-only"):
            image[0, 0] = 1.0


def test_direction_beyond_the_lens_has_no_pixel() -> None:
    """The distorted radius r (1 - 0.3 r^2) is largest at r = 1.054."""
    x, y = np.array([0.0, 1.0, 1.1, 50.0], np.float32), np.zeros(4, np.float32)
    u, _ = project(x, y, camera((-0.3, 0.0, 0.0, 0.0)))
    assert np.isfinite(u).tolist() == [True, True, False, False]
    u, _ = project(x, y, camera((0.1, 0.0, 0.0, 0.0)))
    assert np.isfinite(u).tolist() == [True, True, True, False]
