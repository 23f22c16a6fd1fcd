"""What the map looks like from where it was seen."""

from dataclasses import dataclass

import numpy as np

from ldo_service.gaussians import Rendering, render
from ldo_service.geometry import Camera, se3


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A camera without distortion, and where it stood: T_map_camera [4, 4]."""

    camera: Camera
    T_map_camera: np.ndarray

    def render(self, rows: np.ndarray, threads: int = 1) -> Rendering:
        """The Gaussians rows [N, 16] seen from here."""
        return render(rows, self.camera, se3.inverse(self.T_map_camera), threads=threads)


def surface_depth_m(rendering: Rendering, tolerance_m: float) -> np.ndarray:
    """Depth [H, W] of the surface, 0 where there is none or where it is not sure which.

    The mean depth is smoother than the median, and lies in the air between two surfaces at the
    outline of the nearer one: it counts where it is within `tolerance_m` of the median.
    """
    mean_m, median_m = rendering.depth_m, rendering.median_depth_m
    return np.where(np.abs(mean_m - median_m) <= tolerance_m, mean_m, 0).astype(np.float32)


def surface_color(rendering: Rendering) -> np.ndarray:
    """Colour [H, W, 3], 0..1, without the black background's share."""
    return rendering.color / np.maximum(rendering.opacity, 1e-6)[..., None]
