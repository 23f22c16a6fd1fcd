"""Viewpoints: renderings of the map at the poses of its keyframes."""

from dataclasses import dataclass

import numpy as np

from ldo_service.gaussians import Rendering, render
from ldo_service.geometry import Camera, se3

NEAR_M = 0.01  # Points nearer than this, or behind the camera, project to no pixel.


@dataclass(frozen=True, slots=True)
class Lookup:
    """Values of a depth image at the pixels into which points [..., 3] project.

    Attributes:
        z_m: Depth of each point itself in the camera frame, [...], meters.
        seen_m: Value of the depth image at the pixel of each point, [...], meters; 0 outside the
            image and where the depth is unknown.
        row: Row of the pixel of each point, [...]; 0 outside the image.
        column: Column of the pixel of each point, [...]; 0 outside the image.
    """

    z_m: np.ndarray
    seen_m: np.ndarray
    row: np.ndarray
    column: np.ndarray


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A camera without distortion at the pose T_map_camera [4, 4]."""

    camera: Camera
    T_map_camera: np.ndarray

    def render(self, rows: np.ndarray, threads: int = 1) -> Rendering:
        """Render Gaussians, [N, 16], from this viewpoint."""
        return render(rows, self.camera, se3.inverse(self.T_map_camera), threads=threads)

    def look_up(self, p_camera: np.ndarray, depth_m: np.ndarray) -> Lookup:
        """Read a depth image [H, W] at the pixels of points [..., 3] in the camera frame."""
        z_m = p_camera[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = np.moveaxis(np.rint(self.camera.project(p_camera)), -1, 0)
        inside = (u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height)
        inside &= z_m > NEAR_M
        row, column = (np.where(inside, index, 0).astype(np.int32) for index in (v, u))
        return Lookup(z_m, np.where(inside, depth_m[row, column], 0), row, column)


def surface_depth_m(rendering: Rendering, tolerance_m: float) -> np.ndarray:
    """Return the depth [H, W] of the rendered surface; 0 where it is missing or ambiguous.

    The result is the mean depth, which is smoother than the median depth. At the outline of an
    object, the mean lies between object and background, far from the median. Therefore the result
    is 0 where mean and median differ by more than `tolerance_m`.
    """
    mean_m, median_m = rendering.depth_m, rendering.median_depth_m
    return np.where(np.abs(mean_m - median_m) <= tolerance_m, mean_m, 0).astype(np.float32)


def surface_color(rendering: Rendering) -> np.ndarray:
    """Return the color [H, W, 3], 0..1, of the Gaussians alone, without the black background."""
    return rendering.color / np.maximum(rendering.opacity, 1e-6)[..., None]
