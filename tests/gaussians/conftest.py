"""Fixtures of Gaussian rows and of a small synthetic room."""

from collections.abc import Callable

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.gaussians.densification import DensificationConfig
from ldo_service.geometry import Camera, RgbdFrame

Posed = tuple[RgbdFrame, np.ndarray]  # Frame and T_world_camera.
# Few large Gaussians, because Triton's interpreter takes some milliseconds for each pair of a
# Gaussian and a tile.
FEW = DensificationConfig(coarsest_px=8, max_contrast=9.0, max_depth_step=9.0)


@pytest.fixture
def some_rows() -> np.ndarray:
    """Return rows [200, 16] with varied attributes, opacities near 0 and 1, black and white."""
    rng = np.random.default_rng(5)
    rows = np.zeros((200, 16), np.float32)
    rows[:, 0:3] = rng.uniform(-8, 8, (200, 3))
    rows[:, 3:6] = rng.uniform(-6, -1, (200, 3))
    rows[:, 6:10] = rng.normal(size=(200, 4))
    rows[:, 10] = rng.uniform(-5, 6, 200)
    rows[:, 11:14] = rng.uniform(0, 1, (200, 3))
    rows[0, 11:14], rows[1, 11:14] = 0, 1
    return rows


@pytest.fixture(scope="package")
def small_room(room: Sequence) -> Callable[[int], Posed]:
    """Return a function that gives a frame of the synthetic room at 1/4 size, and its pose."""
    T_world_camera = room.truth().T_world_camera
    return lambda index: (halved(halved(room[index])), T_world_camera[index])


def halved(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame at half of its width and height, averaged over 2x2 pixels."""
    size = (frame.camera.height // 2, 2, frame.camera.width // 2, 2, -1)
    color = frame.color.astype(float).reshape(size).mean(axis=(1, 3))
    depth_m = frame.depth_m.reshape(size).mean(axis=(1, 3))[..., 0]
    return RgbdFrame(np.round(color).astype(np.uint8), depth_m, frame.camera.halved())


def labels_of(n: int, seed: int = 0) -> np.ndarray:
    """Return random label rows [n, 32]."""
    return np.random.default_rng(seed).integers(0, 256, (n, 32), np.uint8)


def window(frame: RgbdFrame, size: int) -> RgbdFrame:
    """Return the middle of a frame, size x size pixels."""
    camera = frame.camera
    x, y = (camera.width - size) // 2, (camera.height - size) // 2
    inside = slice(y, y + size), slice(x, x + size)
    return RgbdFrame(
        np.ascontiguousarray(frame.color[inside]),
        np.ascontiguousarray(frame.depth_m[inside]),
        Camera(size, size, camera.fx, camera.fy, camera.cx - x, camera.cy - y),
    )
