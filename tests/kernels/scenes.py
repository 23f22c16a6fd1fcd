"""Scenes of random Gaussians, and a camera with its principal point off the middle."""

import numpy as np

from ldo_service.geometry import Camera


def camera_of(width: int, height: int) -> Camera:
    return Camera(width, height, 0.9 * width, 0.8 * width, 0.45 * width, 0.55 * height)


def gaussians(n: int, seed: int, *, depth_m: tuple[float, float] = (0.5, 4.0)) -> np.ndarray:
    """Return rows in front of the origin, a third of them beyond the edges of the image."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth_m, n)
    rows = np.zeros((n, 16), np.float32)
    rows[:, 0] = rng.uniform(-0.8, 0.9, n) * np.abs(z)
    rows[:, 1] = rng.uniform(-0.8, 0.7, n) * np.abs(z)
    rows[:, 2] = z
    rows[:, 3:6] = np.log(0.05 * np.abs(z[:, None]) * rng.uniform(0.1, 2, (n, 3)))
    rows[:, 6:10] = rng.normal(size=(n, 4))
    rows[:, 10] = rng.uniform(-3, 6, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows
