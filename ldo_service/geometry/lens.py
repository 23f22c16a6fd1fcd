"""Pixels and rays of a camera whose lens distorts. Conventions: `ldo_service.geometry`."""

from functools import lru_cache

import cv2
import numpy as np

from .camera import Camera

FARTHEST_RADIUS = 4.0  # normalised, 76 degrees from the axis: no pinhole model reaches there


@lru_cache(maxsize=4)
def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Normalised coordinates x, y [H, W] float32 of the pixels, without the lens's distortion."""
    if any(camera.distortion):
        u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
        xy = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion))
        xy = xy.reshape(camera.height, camera.width, 2)
    else:
        xy = camera.rays()[..., :2]
    x, y = (np.ascontiguousarray(xy[..., axis], np.float32) for axis in (0, 1))
    x.flags.writeable = y.flags.writeable = False
    return x, y


def project(x: np.ndarray, y: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels u, v float32 of normalised coordinates x, y float32, by OpenCV's model of distortion.

    NaN beyond the radius at which the polynomial would fold the world back into the image.
    """
    if any(camera.distortion):
        x, y = _distorted(x, y, camera)
    u = np.float32(camera.fx) * x + np.float32(camera.cx)
    v = np.float32(camera.fy) * y + np.float32(camera.cy)
    return u, v


def _distorted(x: np.ndarray, y: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3, k4, k5, k6 = _coefficients(camera).astype(np.float32)
    far = _turning_r2(camera)
    r2 = x * x + y * y
    r2[r2 > far] = np.nan
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@lru_cache(maxsize=4)
def _turning_r2(camera: Camera) -> float:
    """Squared radius at which the lens's polynomial turns round, or where no lens looks anyway."""
    k1, k2, _, _, k3, k4, k5, k6 = _coefficients(camera)
    r = np.linspace(0.0, FARTHEST_RADIUS, 4001)
    r2 = r * r
    bent = r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    turns = np.flatnonzero(np.diff(bent) <= 0)
    return float(r2[turns[0]]) if len(turns) else FARTHEST_RADIUS**2


def _coefficients(camera: Camera) -> np.ndarray:
    """k1 k2 p1 p2 k3 k4 k5 k6, zero where the camera's model has fewer."""
    return np.r_[camera.distortion, np.zeros(8)][:8]
