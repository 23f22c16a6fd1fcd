"""Depth cameras: structured light, time of flight and stereo, with a smooth bias.

All functions use only + - * / and square roots, so results are bitwise equal on every machine.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.geometry import Camera
from ldo_service.synthetic.flat.sensor import (
    is_shadowed,
    is_too_dark,
    matching_noise,
    measured_depth_m,
    normal,
)

from .effects import DepthSensor

# Time of flight, as in an Azure Kinect: on a white surface, the noise is 3 mm + 1.2 mm/m^2 * z^2.
TOF_FLOOR_M, TOF_GROWTH_PER_M = 0.003, 0.0012
TOF_NEAREST_M, TOF_FARTHEST_M = 0.3, 5.5
EDGE = 1.05  # Minimum depth ratio of two neighboring pixels that lie on different surfaces.
# Stereo, as in a RealSense D435: baseline, matching error and subpixel steps of the disparity.
STEREO_BASELINE_M, STEREO_SIGMA_PX, STEREO_STEP_PX = 0.05, 0.08, 1 / 32
STEREO_WINDOW_PX = 5  # Matching window; near surfaces appear wider by half a window on each side.
STEREO_NEAREST_M, STEREO_FARTHEST_M = 0.3, 8.0


@dataclass(frozen=True, slots=True)
class DepthBias:
    """Smooth error of inverse depth, 1 / z' = 1 / z + c20 x^2 + c11 x y + c02 y^2.

    z is the depth without the bias and z' the depth with the bias. x and y are the offset of a
    pixel from the image center, in half image widths. The coefficients are as large as those of the
    ASUS Xtion that recorded the sequence `crowd` of Bonn RGB-D Dynamic. At a depth of 3 m, that
    camera has errors of 70 to 210 mm at the sides of the image.
    """

    c20_per_m: float
    c11_per_m: float
    c02_per_m: float

    @staticmethod
    def of_seed(seed: int) -> "DepthBias":
        """Return the bias of one camera; the seed determines signs and sizes."""
        c20, c11, c02 = np.random.default_rng([seed, 11]).random(3)
        signs = np.where(np.random.default_rng([seed, 12]).random(3) < 0.5, -1.0, 1.0)
        sizes = np.array([0.010 + 0.010 * c20, 0.008 + 0.010 * c11, 0.006 + 0.010 * c02])
        return DepthBias(*(signs * sizes).tolist())

    def inverse_per_m(self, camera: Camera) -> np.ndarray:
        """Return the error of inverse depth at all pixels, [H, W] in 1/m."""
        half = camera.width / 2
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        x, y = (u - (camera.width - 1) / 2) / half, (v - (camera.height - 1) / 2) / half
        return self.c20_per_m * x * x + self.c11_per_m * x * y + self.c02_per_m * y * y

    def biased(self, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
        """Add the bias to measured depth [H, W], meters; 0, which means unknown, stays 0."""
        inverse = 1 / np.where(depth_m > 0, depth_m, 1.0) + self.inverse_per_m(camera)
        return np.where((depth_m > 0) & (inverse > 0), 1 / np.maximum(inverse, 1e-6), 0.0)


def measure(
    sensor: DepthSensor,
    exact_m: np.ndarray,
    light: np.ndarray,
    focal_px: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the depth that a camera measures, [H, W] meters; 0 where unknown.

    Args:
        sensor: Kind of camera.
        exact_m: Exact depth [H, W], meters.
        light: Light [H, W, 3] in 0..1.
        focal_px: Focal length, pixels.
        rng: Source of the noise.
    """
    if sensor == "kinect":
        return measured_depth_m(exact_m, light, focal_px, rng)
    if sensor == "tof":
        return _time_of_flight(exact_m, light, rng)
    if sensor == "stereo":
        return _stereo(exact_m, light, focal_px, rng)
    return exact_m


def _time_of_flight(exact_m: np.ndarray, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return depth [H, W] with noise that grows on dark surfaces, and flying pixels at edges.

    A flying pixel measures a depth between those of two neighboring surfaces.
    """
    small = exact_m.astype(np.float32)
    near_m, far_m = (f(small, np.ones((3, 3))).astype(float) for f in (cv2.erode, cv2.dilate))
    share = rng.random(exact_m.shape)
    flying = (far_m > EDGE * near_m) & (rng.random(exact_m.shape) < 0.5)
    depth_m = np.where(flying, near_m + share * (far_m - near_m), exact_m)
    brightness = np.maximum((light[..., 0] + light[..., 1] + light[..., 2]) / 3, 0.1)
    sigma_m = TOF_FLOOR_M + TOF_GROWTH_PER_M * depth_m * depth_m / np.sqrt(brightness)
    depth_m = depth_m + sigma_m * normal(rng, exact_m.shape)
    seen = (depth_m > TOF_NEAREST_M) & (depth_m < TOF_FARTHEST_M) & ~is_too_dark(light, rng)
    return np.where(seen, depth_m, 0.0)


def _stereo(
    exact_m: np.ndarray, light: np.ndarray, focal_px: float, rng: np.random.Generator
) -> np.ndarray:
    """Return depth [H, W] computed from noisy disparity.

    Near surfaces are widened, and pixels that one of the two cameras does not see have depth 0.
    """
    window = np.ones((STEREO_WINDOW_PX, STEREO_WINDOW_PX))
    widened_m = cv2.erode(exact_m.astype(np.float32), window).astype(float)
    scale = focal_px * STEREO_BASELINE_M
    disparity = scale / widened_m + STEREO_SIGMA_PX * matching_noise(rng, exact_m.shape)
    steps = np.maximum(np.floor(disparity / STEREO_STEP_PX + 0.5), 1.0)
    depth_m = scale / (steps * STEREO_STEP_PX)
    seen = (depth_m > STEREO_NEAREST_M) & (depth_m < STEREO_FARTHEST_M)
    seen &= ~is_shadowed(widened_m, scale) & ~is_too_dark(light, rng)
    return np.where(seen, depth_m, 0.0)
