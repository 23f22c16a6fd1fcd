"""Colour of one camera, as another of the same centre sees it."""

from functools import lru_cache

import cv2
import numpy as np

from ldo_service.errors import FrameError

from .camera import Camera
from .lens import project, rays


def resample_color(
    color: np.ndarray, color_camera: Camera, depth_camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Colour as the depth camera would see it, for two cameras of one centre and orientation.

    Halved while it is more than 1.5 times finer, then interpolated bilinearly: no aliasing.
    color [Hc, Wc, 3] uint8. Returns the image [Hd, Wd, 3] uint8 and is_seen [Hd, Wd] bool, false
    where the colour camera does not look. Raises FrameError when sizes disagree.
    """
    if color.shape[:2] != (color_camera.height, color_camera.width):
        raise FrameError(
            f"colour is {color.shape[1]}x{color.shape[0]} pixels and its camera "
            f"{color_camera.width}x{color_camera.height}. Give the intrinsics of this resolution."
        )
    while min(color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy) > 1.5:
        color, color_camera = _halved(color), color_camera.halved()
    u, v, is_seen = _color_of_depth_pixels(color_camera, depth_camera)
    image = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return image, is_seen


def _halved(color: np.ndarray) -> np.ndarray:
    height, width = color.shape[0] // 2, color.shape[1] // 2
    return cv2.resize(
        color[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
    )


@lru_cache(maxsize=4)
def _color_of_depth_pixels(
    color_camera: Camera, depth_camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where in the colour image each depth pixel lies: u, v [Hd, Wd] float32; whether inside."""
    u, v = project(*rays(depth_camera), color_camera)
    width, height = color_camera.width, color_camera.height
    with np.errstate(invalid="ignore"):
        is_seen = (np.abs(u - (width - 1) / 2) <= width / 2) & (
            np.abs(v - (height - 1) / 2) <= height / 2
        )
    return u, v, is_seen
