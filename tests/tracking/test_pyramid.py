import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera
from ldo_service.tracking.pyramid import (
    PyramidConfig,
    build_pyramid,
    halved_depth,
    halved_image,
    pyramid_of,
)


def ramp(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return (3.0 * u + 5.0 * v + 1.0).astype(np.float32)  # 0 would count as clipped.


@pytest.mark.parametrize("size", [(8, 12), (9, 13)])
def test_halved_pixel_is_centered_between_four_pixels(size: tuple[int, int]) -> None:
    half = halved_image(ramp(*size))
    v, u = np.mgrid[: half.shape[0], : half.shape[1]]
    np.testing.assert_allclose(half, 3.0 * (2 * u + 0.5) + 5.0 * (2 * v + 0.5) + 1.0, rtol=1e-6)


def test_halved_depth_of_a_plane_is_that_of_the_halved_camera() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 30.0, 25.0)
    normal, offset = np.array([0.1, 0.2, 1.0]), 2.0

    def plane(camera: Camera) -> np.ndarray:
        return (offset / (camera.rays() @ normal)).astype(np.float32)

    half = halved_depth(plane(camera), 0.03)
    np.testing.assert_allclose(half, plane(camera.halved()), rtol=2e-5)


def test_halved_depth_keeps_the_nearer_side_of_an_edge_and_ignores_holes() -> None:
    blocks = np.array([[1.0, 3.0, 0.0, 0.0], [1.02, 3.0, 0.0, 2.0]], np.float32)
    np.testing.assert_allclose(halved_depth(blocks, 0.03), [[1.01, 2.0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("width", "height", "finest", "levels"),
    [(640, 480, 320, 4), (512, 512, 256, 4), (1280, 720, 320, 4), (80, 60, 80, 3), (3, 2, 3, 1)],
)
def test_every_resolution_has_a_pyramid(width: int, height: int, finest: int, levels: int) -> None:
    camera = Camera(width, height, width, width, width / 2, height / 2)
    gray = np.zeros((height, width), np.uint8)
    pyramid = build_pyramid(gray, np.ones((height, width), np.float32), camera, PyramidConfig())
    assert pyramid.levels[0].camera.width == finest
    assert len(pyramid.levels) == levels
    for level in pyramid.levels:
        assert level.texels.shape == (level.camera.height, level.camera.width, 4)


def test_depth_beyond_any_sensor_is_missing(room) -> None:
    frame = room.view(np.eye(4))
    frame.depth_m[:40] = 1e37
    levels = pyramid_of(frame, PyramidConfig()).levels
    assert np.all(levels[0].depth_m[:40] == 0)
    assert all(level.depth_m.max() < 10 for level in levels)


def test_pyramid_without_levels_is_rejected() -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        PyramidConfig(levels=0)


def test_clipped_pixels_have_no_intensity_on_any_level() -> None:
    gray = np.full((64, 96), 100, np.uint8)
    gray[:, 20:] = 255
    gray[:, 40:] = 0
    gray[3, 24] = 130  # The only unclipped pixel of its block.
    depth_m = np.ones(gray.shape, np.float32)
    camera = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
    config = PyramidConfig(working_width_px=96, levels=3)
    levels = [level.texels for level in build_pyramid(gray, depth_m, camera, config).levels]
    for scale, texels in zip((1, 2, 4), levels, strict=True):
        intensity = texels[..., 0].copy()
        assert intensity[3 // scale, 24 // scale] == 130
        intensity[3 // scale, 24 // scale] = 0
        edge = -(-20 // scale)
        assert (intensity[:, :edge] == 100).all()
        assert not intensity[:, edge:].any()
        assert not texels[..., 1:3].any(), "no gradient towards a clipped pixel"
