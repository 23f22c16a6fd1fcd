"""Compensation of the motion during a frame, compared with NumPy and OpenCV."""

from collections.abc import Callable

import numpy as np
import pytest

from ldo_service.calibration.shutter import FrameMotion, ShutterTiming
from ldo_service.geometry import Camera
from ldo_service.kernels import _shutter
from tests.reference import shutter

TIMING = ShutterTiming(0.030, 0.020, -0.012)
VELOCITY = np.array([0.5, -0.8, 0.6, 0.2, 0.1, -0.3])
CAMERA = Camera(318, 237, 260.0, 262.0, 155.5, 121.5)  # The last cells are cut off.


def frame(camera: Camera, channels: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return an image and depth with missing pixels."""
    rng = np.random.default_rng(0)
    size = camera.height, camera.width
    image = rng.integers(1, 256, (*size, channels), dtype=np.uint8)
    image[rng.random(size) < 0.02] = 0
    image[40:60, 70:90] = 0
    depth_m = (2.0 + np.sin(np.arange(size[1]) / 40) + rng.random(size)).astype(np.float32)
    depth_m[rng.random(size) < 0.3] = 0
    return (image[..., 0] if channels == 1 else image), depth_m


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("timing", [TIMING, ShutterTiming(0.03), ShutterTiming(depth_delay_s=0.02)])
def test_warp_is_that_of_numpy(channels: int, timing: ShutterTiming) -> None:
    image, depth_m = frame(CAMERA, channels)
    motion = FrameMotion(VELOCITY, timing)
    moved, moved_m = motion.warped(image, depth_m, CAMERA)
    expected, expected_m = shutter.warped(image, depth_m, CAMERA, motion)
    # A place on the border between two pixels may round to either side.
    assert np.mean(moved != expected) < 2e-4
    assert np.mean(np.abs(moved_m - expected_m) > 1e-5) < 1e-3
    assert np.mean(moved != image) > 0.5 or not timing.readout_s


def test_image_motion_is_that_of_numpy() -> None:
    _, depth_m = frame(CAMERA)
    intrinsics = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    motion = _shutter.image_motion(depth_m, intrinsics, VELOCITY)
    flow, z_per_s = shutter.image_motion(depth_m, CAMERA, VELOCITY)
    assert motion.shape == (3, 30, 40)
    np.testing.assert_allclose(motion[:2], flow, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(motion[2], z_per_s, rtol=1e-4, atol=1e-6)


def test_pixel_beside_a_missing_one_is_missing() -> None:
    image, depth_m = frame(CAMERA)
    image[:] = 200
    image[100, 100] = 0
    moved, _ = FrameMotion(VELOCITY, TIMING).warped(image, depth_m, CAMERA)
    assert set(np.unique(moved)) == {0, 200}
    assert 1 <= np.count_nonzero(moved[90:110, 90:110] == 0) <= 9


def test_image_without_displacement_is_unchanged() -> None:
    image, depth_m = frame(CAMERA)
    still = FrameMotion(VELOCITY, ShutterTiming(depth_delay_s=0.01))
    assert np.array_equal(still.warped(image, depth_m, CAMERA)[0], image)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (3, 2)])
def test_smallest_images_are_handled(size: tuple[int, int]) -> None:
    camera = Camera(size[1], size[0], 5.0, 5.0, 0.5, 0.5)
    moved, depth_m = FrameMotion(VELOCITY, TIMING).warped(
        np.full(size, 9, np.uint8), np.full(size, 2, np.float32), camera
    )
    assert moved.shape == depth_m.shape == size
    assert np.isfinite(depth_m).all()


def test_depth_that_is_not_finite_moves_nothing_out_of_bounds() -> None:
    image, depth_m = frame(CAMERA)
    depth_m[::3] = np.nan
    depth_m[1::3] = np.inf
    depth_m[2::3] = 1e-30
    moved, _ = FrameMotion(VELOCITY, TIMING).warped(image, depth_m, CAMERA)
    assert moved.shape == image.shape


def test_result_is_bitwise_equal_for_each_instruction_set(with_isa: Callable) -> None:
    image, depth_m = frame(CAMERA, 3)
    given = {"image": image, "depth_m": depth_m, "velocity": VELOCITY, "times_s": TIMING.times_s}
    found = with_isa(
        "from ldo_service.kernels._shutter import warp\n"
        f"camera = {(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)}\n"
        "g = given\n"
        "times_s = tuple(g['times_s'])\n"
        "a, b = warp(g['image'], g['depth_m'], camera, g['velocity'], times_s)\n"
        "result.update(image=a, depth_m=b)",
        given,
    )
    moved, moved_m = FrameMotion(VELOCITY, TIMING).warped(image, depth_m, CAMERA)
    assert found["image"].tobytes() == moved.tobytes()
    assert found["depth_m"].tobytes() == moved_m.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.ones((4, 5, 2), np.uint8)}, r"image must have shape \[4, 5, 3\]"),
        ({"image": np.ones((4, 6), np.uint8)}, r"image must have shape \[4, 5\]"),
        ({"image": np.ones((4, 5), np.float32)}, "image must be uint8"),
        ({"depth": np.ones((4, 5))}, "depth must be float32"),
        ({"depth": np.ones(4, np.float32)}, r"depth must have shape \[H, W\]"),
        ({"velocity": np.ones(5)}, r"velocity must have shape \[6\]"),
        ({"intrinsics": (0.0, 1.0, 0.0, 0.0)}, "intrinsics"),
        ({"intrinsics": (1.0, 1.0, float("nan"), 0.0)}, "intrinsics"),
    ],
)
def test_invalid_arguments_are_rejected(change: dict, message: str) -> None:
    arguments = {
        "image": np.ones((4, 5), np.uint8),
        "depth": np.ones((4, 5), np.float32),
        "intrinsics": (4.0, 4.0, 2.0, 1.5),
        "velocity": VELOCITY,
        "times_s": TIMING.times_s,
    }
    with pytest.raises(ValueError, match=message):
        _shutter.warp(**{**arguments, **change})
