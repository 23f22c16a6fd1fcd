import cv2
import numpy as np
import pytest

from ldo_service.errors import FrameError
from ldo_service.geometry import (
    Camera,
    RawFrame,
    Rectifier,
    RgbdFrame,
    rectify,
    undistortion_maps,
    valid_pixels,
)
from ldo_service.geometry.frames import pixels_without_data
from tests.geometry.cameras import FREIBURG1

CAMERA = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, FREIBURG1)
SMALL = Camera(4, 3, 3, 3, 1.5, 1)


def raw_frame(depth: np.ndarray, scale: float = 1000.0, camera: Camera = SMALL) -> RawFrame:
    return RawFrame(5, 0, np.zeros((3, 4, 3), np.uint8), depth, scale, camera)


def seen_through_the_lens(image: np.ndarray) -> np.ndarray:
    """Return what the distorted camera sees of an undistorted image, by cv2.projectPoints."""
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    seen = np.stack([u, v], -1).reshape(-1, 2)
    zero, ideal = np.zeros(3), seen.copy()
    for _ in range(12):  # Solve p = distort(ideal) by fixed-point steps.
        rays = np.c_[
            (ideal - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(u.flat))
        ]
        bent = cv2.projectPoints(rays, zero, zero, CAMERA.matrix, np.array(FREIBURG1))[0][:, 0]
        ideal += seen - bent
    maps = ideal.reshape(480, 640, 2).astype(np.float32)
    return cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)


def grid() -> np.ndarray:
    image = np.full((480, 640, 3), 255, np.uint8)
    for x in range(20, 640, 60):
        image[:, x - 2 : x + 3] = 0
    for y in range(30, 480, 60):
        image[y - 2 : y + 3] = 0
    return image


def test_lines_bent_by_the_lens_are_rectified_to_straight_lines() -> None:
    bent = seen_through_the_lens(grid())
    raw = RawFrame(0, 0, bent, np.ones((480, 640), np.float32), 1.0, CAMERA)
    frame = Rectifier()(raw)
    middle = np.s_[60:420, 80:560]
    error = np.abs(frame.color[middle].astype(float) - grid()[middle])
    untouched = np.abs(bent[middle].astype(float) - grid()[middle])
    assert error.mean() < 5
    assert untouched.mean() > 20
    assert frame.camera == CAMERA.rectified()


def test_depth_takes_the_nearest_pixel_and_never_a_mean() -> None:
    depth = np.where(np.arange(640) % 7 < 3, 1000, 3000).astype(np.uint16)
    raw = RawFrame(0, 0, np.zeros((480, 640, 3), np.uint8), np.tile(depth, (480, 1)), 1e3, CAMERA)
    frame = Rectifier()(raw)
    assert set(np.unique(frame.depth_m)) <= {0.0, 1.0, 3.0}
    assert (frame.depth_m > 0).mean() > 0.9


def test_integer_depth_becomes_meters_at_its_scale() -> None:
    frame = rectify(raw_frame(np.full((3, 4), 12345, np.uint16), 5000.0), None)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m, 2.469, rtol=1e-7)
    assert (frame.index, frame.stamp_ns) == (5, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 3e38])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_invalid_depth_becomes_missing(bad: float, dtype: type) -> None:
    depth = np.full((3, 4), 2.0, dtype)
    depth[1, 1] = bad
    depth_m = rectify(raw_frame(depth, 0.5), None).depth_m
    assert depth_m[1, 1] == 0
    assert np.delete(depth_m, 5).tolist() == [4.0] * 11


def test_frame_without_distortion_is_unchanged() -> None:
    raw = raw_frame(np.ones((3, 4), np.float32))
    assert undistortion_maps(Camera(4, 3, 3, 3, 1.5, 1, (0.0,) * 5)) is None
    assert rectify(raw, None).color is raw.color


def test_rectifier_follows_a_camera_that_changes() -> None:
    rectifier, color = Rectifier(), grid()
    depth = np.ones((480, 640), np.float32)
    bent = rectifier(RawFrame(0, 0, color, depth, 1.0, CAMERA)).color
    straight = rectifier(RawFrame(1, 0, color, depth, 1.0, CAMERA.rectified())).color
    again = rectifier(RawFrame(2, 0, color, depth, 1.0, CAMERA)).color
    assert np.array_equal(straight, color)
    assert np.array_equal(bent, again)
    assert not np.array_equal(bent, straight)


def test_color_of_another_size_than_depth_is_an_error() -> None:
    color = np.zeros((6, 8, 3), np.uint8)
    with pytest.raises(FrameError, match=r"frame 3: color is 8x6 and depth 4x3.*Register"):
        RawFrame(3, 0, color, np.zeros((3, 4), np.uint16), 1000, SMALL)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"color": np.zeros((3, 4), np.uint8)}, "color"),
        ({"color": np.zeros((3, 4, 3), np.float32)}, "color"),
        ({"depth": np.zeros((3, 4), np.uint8)}, "depth is uint8"),
        ({"depth": np.zeros((3, 4, 1), np.uint16)}, "depth"),
        ({"camera": CAMERA}, "640x480"),
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"depth_scale": float("nan")}, "depth_scale"),
    ],
)
def test_parts_that_do_not_match_are_named(changes: dict, word: str) -> None:
    parts = {
        "index": 1,
        "stamp_ns": 0,
        "color": np.zeros((3, 4, 3), np.uint8),
        "depth": np.zeros((3, 4), np.uint16),
        "depth_scale": 1000.0,
        "camera": SMALL,
    }
    with pytest.raises(FrameError, match=word):
        RawFrame(**(parts | changes))


def test_valid_pixels_are_those_that_show_the_white_of_a_white_image() -> None:
    camera = Camera(64, 48, 60, 60, 31.5, 23.5, (0.3, -0.1, 0.0, 0.0, 0.0))
    white = np.full((48, 64, 3), 255, np.uint8)
    raw = RawFrame(0, 0, white, np.ones((48, 64), np.float32), 1.0, camera)
    shown = rectify(raw, undistortion_maps(camera)).color.min(axis=2)
    valid = valid_pixels(camera)
    assert valid is not None
    assert (shown[valid] == 255).all()
    assert (shown[~valid] < 255).all()
    assert 0.5 < valid.mean() < 1.0
    assert valid_pixels(camera.rectified()) is None


def test_pixels_without_data_are_the_rim_and_no_dark_hole_inside() -> None:
    camera = Camera(64, 48, 60, 60, 31.5, 23.5, (0.3, -0.1, 0.0, 0.0, 0.0))
    white = np.full((48, 64, 3), 255, np.uint8)
    white[20:25, 30:40] = 0
    depth = np.ones((48, 64), np.float32)
    depth[20:25, 30:40] = 0
    frame = rectify(RawFrame(0, 0, white, depth, 1.0, camera), undistortion_maps(camera))
    rim, valid = pixels_without_data(frame), valid_pixels(camera)
    assert valid is not None
    assert rim[~valid].all()
    inside = cv2.erode(valid.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    assert inside.any()
    assert not rim[inside].any()
    assert not pixels_without_data(RgbdFrame(white, depth, camera.rectified())).any()
