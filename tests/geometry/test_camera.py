import numpy as np
import pytest

from ldo_service.errors import DataError
from ldo_service.geometry import Camera

CAMERA = Camera(64, 48, 50.0, 52.0, 31.2, 22.9)


def test_projection_returns_to_the_pixel_that_was_backprojected() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 4, (48, 64)).astype(np.float32)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    pixels = CAMERA.project(CAMERA.backproject(depth_m))
    np.testing.assert_allclose(pixels, np.stack([u, v], -1), atol=1e-4)


def test_projection_is_the_product_with_the_intrinsic_matrix() -> None:
    points = np.random.default_rng(1).uniform([-1, -1, 1], [1, 1, 3], (10, 3))
    homogeneous = points @ CAMERA.matrix.T
    np.testing.assert_allclose(CAMERA.project(points), homogeneous[:, :2] / homogeneous[:, 2:])


def test_points_between_pixels_lie_on_their_rays() -> None:
    u, v, depth_m = np.array([[0.5, 31.2]]), np.array([[7.25], [22.9]]), np.array([[2.0, 3.0]])
    points = CAMERA.points_at(u, v, depth_m)
    assert points.shape == (2, 2, 3)
    np.testing.assert_allclose(points[..., 2], np.broadcast_to(depth_m, (2, 2)))
    np.testing.assert_allclose(CAMERA.project(points), np.stack(np.broadcast_arrays(u, v), -1))
    np.testing.assert_array_equal(points[1, 1], [0, 0, 3])


def test_missing_depth_backprojects_to_the_origin() -> None:
    assert not CAMERA.backproject(np.zeros((48, 64), np.float32)).any()


def test_halved_camera_sees_the_mean_of_four_pixels_between_them() -> None:
    points = np.array([[0.1, -0.2, 1.5], [-0.4, 0.3, 2.0]])
    fine, coarse = CAMERA.project(points), CAMERA.halved().project(points)
    np.testing.assert_allclose(coarse, (fine + 0.5) / 2 - 0.5)
    assert (CAMERA.halved().width, CAMERA.halved().height) == (32, 24)


def test_halving_keeps_the_lens_and_rectifying_removes_it() -> None:
    camera = Camera(64, 48, 50, 50, 32, 24, (0.1, 0.01, 0, 0))
    assert camera.halved().distortion == camera.distortion
    assert camera.rectified().distortion == ()
    assert camera.rectified().matrix.tolist() == camera.matrix.tolist()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ((0, 48, 50, 50, 32, 24), "0x48"),
        ((64.5, 48, 50, 50, 32, 24), "width=64.5 must be an integer"),
        ((64, True, 50, 50, 32, 24), "height=True must be an integer"),
        ((64, 48, -50, 50, 32, 24), "focal"),
        ((64, 48, float("nan"), 50, 32, 24), "NaN"),
        ((64, 48, 50, 50, 640, 24), "cx=640"),
        ((64, 48, 50, 50, 32, -480), "cy=-480"),
        ((64, 48, 50, 50, 32, 24, (0.1,)), "1 distortion"),
        ((64, 48, 50, 50, 32, 24, (0.1, float("inf"), 0, 0)), "infinity"),
    ],
)
def test_impossible_intrinsics_are_named(values: tuple, word: str) -> None:
    with pytest.raises(DataError, match=word):
        Camera(*values)


@pytest.mark.parametrize("width", [160, 161, 641])
@pytest.mark.parametrize("cx_ratio", [-1.0, 2.0])
@pytest.mark.parametrize("focal_ratio", [0.02, 100.0])
def test_camera_at_the_limits_can_be_halved(
    width: int, cx_ratio: float, focal_ratio: float
) -> None:
    cx = np.nextafter(cx_ratio * width, 0.0)
    camera = Camera(width, 120, focal_ratio * width, focal_ratio * 120, cx, 60.0)
    for _ in range(4):
        camera = camera.halved()
    assert camera.width == width // 16
    assert camera.cx == pytest.approx((cx + 0.5) / 16 - 0.5)


def test_distortion_that_no_lens_has_is_named() -> None:
    shrinking = (1e9, 0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 0.0)  # By 1000, and increasing steadily.
    with pytest.raises(DataError, match="fits no real lens"):
        Camera(640, 480, 64000.0, 48000.0, 320.0, 240.0, shrinking)
    Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
