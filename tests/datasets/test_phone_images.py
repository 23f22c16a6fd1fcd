import numpy as np
import pytest

from ldo_service.datasets.phone_images import PhoneGrid, enlarge_depth, scaled, without_doubt
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera
from ldo_service.geometry.camera import rays

FULL = Camera(1920, 1440, 1500.0, 1510.0, 961.0, 722.0, (0.1, 0.0, 0.0, 0.0))


def plane_m(camera: Camera, width: int, height: int) -> np.ndarray:
    """Return the depth [height, width] of a slanted plane, by the exact intersection of its rays.

    The image has the field of view of `camera`.
    """
    u = (np.arange(width) + 0.5) * camera.width / width - 0.5
    v = (np.arange(height)[:, None] + 0.5) * camera.height / height - 0.5
    rays = camera.rays_at(u, v)
    return (2.0 / (rays @ [0.4, -0.3, 1.0])).astype(np.float32)


@pytest.mark.parametrize("size", [(1920, 1440), (1922, 1443), (1000, 750)])
def test_enlarged_depth_of_a_plane_is_exact(size: tuple[int, int]) -> None:
    """If the size is no multiple of the block, the grid lacks the last columns."""
    width, height = size
    full = Camera(width, height, 0.8 * width, 0.8 * width, width / 2 - 3, height / 2 + 5)
    grid = PhoneGrid(full)
    color = np.zeros((height, width, 3), np.uint8)
    raw = grid.frame(0, 0, color, plane_m(full, 256, 192), 1.0)
    expected = plane_m(grid.camera, grid.camera.width, grid.camera.height)
    inner = (slice(4, -4), slice(4, -4))  # The outer depth pixels have their centers inside.
    np.testing.assert_allclose(raw.depth[inner], expected[inner], rtol=2e-6)


def test_color_is_the_mean_of_blocks_and_the_intrinsics_follow() -> None:
    rng = np.random.default_rng(1)
    color = rng.integers(0, 255, (1440, 1920, 3), np.uint8)
    raw = PhoneGrid(FULL).frame(0, 0, color, np.ones((192, 256), np.uint16), 1000.0)
    mean = color.reshape(480, 3, 640, 3, 3).mean((1, 3))
    assert np.max(np.abs(raw.color - mean)) <= 0.5 + 1e-6
    assert raw.camera == Camera(
        *(640, 480, 500.0, 1510 / 3, 961.5 / 3 - 0.5, 722.5 / 3 - 0.5), FULL.distortion
    )


def test_images_of_the_size_of_the_grid_do_not_change() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    color, depth = np.full((480, 640, 3), 7, np.uint8), np.full((480, 640), 9, np.uint16)
    raw = PhoneGrid(camera).frame(0, 0, color, depth, 5000.0)
    assert raw.color is color
    assert raw.depth is depth
    assert raw.camera == camera


def test_depth_between_two_surfaces_and_beside_unmeasured_pixels_is_dropped() -> None:
    depth = np.ones((4, 8), np.float32)
    depth[:, 4:] = 2.0
    depth[:, 7] = np.nan
    large = enlarge_depth(depth, (16, 32), (16.0, 32.0))
    assert set(np.unique(large)) == {0.0, 1.0, 2.0}
    expected = np.zeros(32)
    expected[:14], expected[18:26] = 1, 2  # Each surface ends at its last pixel center.
    assert np.array_equal(large, np.broadcast_to(expected, (16, 32)))


def test_depth_of_low_confidence_is_dropped() -> None:
    depth = np.full((2, 3), 500, np.uint16)
    kept = without_doubt(depth, np.array([[0, 1, 2], [2, 2, 1]], np.uint8), "a.png")
    assert kept.tolist() == [[0, 0, 500], [500, 500, 0]]
    assert kept.dtype == np.uint16
    with pytest.raises(FrameError, match=r"a\.png has the shape \(1, 3\).*\(2, 3\)"):
        without_doubt(depth, np.zeros((1, 3), np.uint8), "a.png")


def test_frame_of_another_focal_length_is_resampled_to_the_grid() -> None:
    """A gradient in the viewing ray stays in its place when the focal length changes."""
    grid = PhoneGrid(FULL)
    other = Camera(1920, 1440, 1400.0, 1410.0, 900.0, 760.0, FULL.distortion)
    images = [_gradient(camera) for camera in (FULL, other)]
    depth = np.full((192, 256), 2000, np.uint16)
    expected, found = (
        grid.frame(0, 0, image, depth, 1000.0, camera)
        for image, camera in zip(images, (None, other), strict=True)
    )
    assert np.abs(images[0].astype(int) - images[1])[700:740, 1600:1700].mean() > 3
    inner = (slice(40, -40), slice(40, -40))
    assert np.max(np.abs(found.color[inner].astype(int) - expected.color[inner])) <= 1
    assert np.array_equal(found.depth[inner], expected.depth[inner])
    assert found.camera == expected.camera == grid.camera


def test_color_of_a_wrong_size_is_a_bad_frame() -> None:
    with pytest.raises(
        FrameError, match="color is 960x720 pixels, but its intrinsics are for 1920x144"
    ):
        PhoneGrid(FULL).frame(
            3, 0, np.zeros((720, 960, 3), np.uint8), np.ones((192, 256), np.uint16), 1000.0
        )


def test_intrinsics_of_another_aspect_ratio_are_rejected() -> None:
    assert scaled(FULL, 960, 720, "x").fx == 750.0
    with pytest.raises(DataError, match=r"a\.r3d: the images have 960x960 pixels"):
        scaled(FULL, 960, 960, "a.r3d")


def _gradient(camera: Camera) -> np.ndarray:
    x, y = rays(camera)
    return np.clip(
        np.stack([128 + 150 * x, 128 + 150 * y, 128 + 80 * x - 80 * y], -1), 0, 255
    ).astype(np.uint8)
