"""A room with exact images: four walls and a block, textured with noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from ldo_service.geometry import Camera, RgbdFrame, se3

CELL_M = 0.12  # Size of a texture cell; about ten pixels.
TEXTURE = np.random.default_rng(7).uniform(20, 235, (64, 64, 64)).astype(np.float32)
BOXES = (  # Low and high corners, m; the camera is inside the first.
    (np.array([-2.0, -1.3, -1.5]), np.array([2.0, 1.2, 3.2])),
    (np.array([-0.9, 0.3, 1.6]), np.array([0.1, 1.2, 2.4])),
)


@dataclass(frozen=True)
class Room:
    camera: Camera

    def view(
        self,
        T_world_camera: np.ndarray,
        gain: float = 1.0,
        bias: float = 0.0,
        stamp_ns: int = 0,
        index: int = 0,
    ) -> RgbdFrame:
        rays_world = self.camera.rays() @ T_world_camera[:3, :3].T
        depth_m = _depth(T_world_camera[:3, 3], rays_world)
        points_world = T_world_camera[:3, 3] + rays_world * depth_m[..., None]
        shade = map_coordinates(
            TEXTURE, points_world.reshape(-1, 3).T / CELL_M, order=1, mode="grid-wrap"
        )
        gray = np.clip(gain * shade.reshape(depth_m.shape) + bias, 0, 255)
        color = np.repeat(np.rint(gray)[..., None], 3, axis=2).astype(np.uint8)
        return RgbdFrame(color, depth_m.astype(np.float32), self.camera, stamp_ns, index)

    def blank(self, index: int = 0, stamp_ns: int = 0) -> RgbdFrame:
        size = (self.camera.height, self.camera.width)
        color, depth_m = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
        return RgbdFrame(color, depth_m, self.camera, stamp_ns, index)


def _depth(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the depth along rays [H, W, 3] of camera z = 1, by the slab method."""
    entries, exits = [], []
    for low, high in BOXES:
        with np.errstate(divide="ignore"):
            a, b = (low - origin) / rays, (high - origin) / rays
        entries.append(np.minimum(a, b).max(axis=-1))
        exits.append(np.maximum(a, b).min(axis=-1))
    is_block = (entries[1] < exits[1]) & (entries[1] > 0)
    return np.where(is_block, entries[1], exits[0])


def room_of(width: int, height: int) -> Room:
    focal_px = 0.8 * width
    return Room(Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2))


@pytest.fixture(scope="session")
def room() -> Room:
    return room_of(160, 120)


@pytest.fixture(scope="session")
def large_room() -> Room:
    return room_of(320, 240)


@pytest.fixture(scope="session")
def make_room() -> Callable[[int, int], Room]:
    return room_of


def walk(frames: int, step_m: float = 0.02, step_rad: float = 0.01) -> list[np.ndarray]:
    """Return poses along a gentle curve."""
    twist = np.array([0.3 * step_rad, step_rad, 0.1 * step_rad, step_m, 0.2 * step_m, 0.4 * step_m])
    return [se3.exp(k * twist) for k in range(frames)]


@pytest.fixture(scope="session")
def make_walk() -> Callable[..., list[np.ndarray]]:
    return walk
