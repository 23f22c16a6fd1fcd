"""Sensor model of a Kinect-like camera: motion blur, exposure, noise and depth errors."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.synthetic.room_sequence import DISPARITY_SIGMA_STEPS, DISPARITY_STEP_PER_M

from .render import FlatRendering
from .walk import RATE_HZ, CameraPath, closed_spline

# Exposure time indoors in the evening. A turn of 60 degrees per second blurs over 11 pixels, at an
# image width of 640.
SHUTTER_S = 0.02
BLUR_TAPS = 7  # Samples along the motion of each pixel.
# Random drift of the gain: time between its knots, and largest deviation from 1.
EXPOSURE_S, EXPOSURE_SPREAD = 3.0, 0.2
NOISE = 0.008  # Standard deviation as a fraction of full scale: 2 gray levels.

NEAREST_M, FARTHEST_M = 0.4, 5.0
BASELINE_PX_M = 0.075  # Baseline of projector and camera in meters, for a focal length of 1 pixel.
DARK = 0.12  # Brightness below which the camera begins to lose the projected pattern.
PATCH_PX = 8  # Size of the holes on dark surfaces.
WINDOW_PX = 6  # Size of the matching windows, in which neighbors have similar errors.
# Standard deviations of the disparity noise that is common to a matching window, and of the
# noise of a single pixel. Both are fractions of the total; their squares sum to 1.
SHARED_NOISE, OWN_NOISE = 0.8, 0.6


@dataclass(frozen=True, slots=True)
class Sensor:
    """Kinect-like camera on a walk; `seed` determines the drift of the camera's gain."""

    camera: Camera
    walk: CameraPath
    seed: int

    def color(self, frame: int, rendering: FlatRendering, rng: np.random.Generator) -> np.ndarray:
        """Return the light [H, W, 3] that the camera records, with motion blur, gain and noise.

        Motion during the exposure is approximated as linear. Each pixel is the mean of the sharp
        image along the path of its surface point through the image. Surfaces that the motion
        uncovers are not modeled. Full scale is 1; values are not clipped.
        """
        gain = 1 + EXPOSURE_SPREAD * self._drift(frame)
        blurred = blur(rendering.light, *self.motion_px(frame, rendering.depth_m))
        return gain * blurred + NOISE * normal(rng, blurred.shape)

    def depth_m(self, rendering: FlatRendering, rng: np.random.Generator) -> np.ndarray:
        """Return the measured depth [H, W], meters; 0 where unknown."""
        return measured_depth_m(rendering.depth_m, rendering.light, self.camera.fx, rng)

    def motion_px(self, frame: int, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the image motion in u and v, each [H, W] pixels, while the shutter is open."""
        half = SHUTTER_S * RATE_HZ / 2
        T_world_camera = self.walk.pose(frame)
        opened, closed = (
            _projected(self.camera, self.walk.pose(frame + step), T_world_camera, depth_m)
            for step in (-half, half)
        )
        return closed[0] - opened[0], closed[1] - opened[1]

    def _drift(self, frame: int) -> float:
        """Return the drift of the gain in -1..1, which varies slowly over the frames."""
        count = int(self.walk.frames / RATE_HZ / EXPOSURE_S)
        knots = np.random.default_rng([self.seed, 3]).random((count, 1)) * 2 - 1
        drift = closed_spline(knots, np.array([frame / self.walk.frames * count]))[0, 0]
        return float(min(max(drift, -1.0), 1.0))


def measured_depth_m(
    exact_m: np.ndarray, light: np.ndarray, focal_px: float, rng: np.random.Generator
) -> np.ndarray:
    """Return depth with the errors of a Kinect-like camera.

    At a depth of z meters, the depth has steps of 2.85e-3 z^2 meters (Khoshelham and Elberink,
    Sensors 2012). It has ragged edges and noise of half a step; neighboring pixels have similar
    noise. Depth is unknown in the projector's shadow, on dark patches and outside 0.4 to 5 m.

    Args:
        exact_m: Exact depth [H, W], meters.
        light: Light [H, W, 3] in 0..1.
        focal_px: Focal length, pixels.
        rng: Source of the noise.

    Returns:
        Depth [H, W], meters; 0 where unknown.
    """
    disparity = 1 / (_ragged(exact_m, rng) * DISPARITY_STEP_PER_M)
    disparity = disparity + DISPARITY_SIGMA_STEPS * matching_noise(rng, exact_m.shape)
    measured = 1 / (np.maximum(np.floor(disparity + 0.5), 1.0) * DISPARITY_STEP_PER_M)
    seen = (measured >= NEAREST_M) & (measured <= FARTHEST_M)
    seen &= ~is_shadowed(exact_m, BASELINE_PX_M * focal_px)
    return np.where(seen & ~is_too_dark(light, rng), measured, 0.0)


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return random numbers of zero mean and unit variance, bitwise equal on every machine.

    Each number is a scaled sum of three uniform numbers, so the distribution is nearly normal.
    Exact normal numbers need logarithms, and the bits of logarithms differ between machines.
    """
    total = rng.random(shape) + rng.random(shape) + rng.random(shape)  # Variance 3 / 12.
    return 2 * (total - 1.5)


def blur(light: np.ndarray, du_px: np.ndarray, dv_px: np.ndarray) -> np.ndarray:
    """Return the mean [H, W, 3] of the image along a line centered at each pixel.

    Args:
        light: Image [H, W, 3].
        du_px: Extent [H, W] of the line in u, pixels.
        dv_px: Extent [H, W] of the line in v, pixels.
    """
    v, u = np.mgrid[: light.shape[0], : light.shape[1]]
    total = np.zeros(light.shape)
    for tap in range(BLUR_TAPS):
        share = (tap + 0.5) / BLUR_TAPS - 0.5
        total += _sampled(light, u + share * du_px, v + share * dv_px)
    return total / BLUR_TAPS


def is_shadowed(depth_m: np.ndarray, baseline_px_m: float) -> np.ndarray:
    """Return a mask [H, W] of the pixels that the projector does not reach.

    The projector is to the left of the camera. Pixel u with depth z lies at u + b f / z in the
    projector's image, and the projector lights only the nearest surface there.

    Args:
        depth_m: Exact depth [H, W], meters.
        baseline_px_m: Baseline in meters times focal length in pixels, b f.
    """
    height, width = depth_m.shape
    shift = baseline_px_m / np.maximum(depth_m, NEAREST_M)
    column = np.floor(np.arange(width) + shift + 0.5).astype(np.int64)
    row = np.broadcast_to(np.arange(height)[:, None], depth_m.shape)
    nearest_m = np.full((height, int(column.max()) + 1), np.inf)
    np.minimum.at(nearest_m, (row, column), depth_m)
    return depth_m > 1.05 * nearest_m[row, column]


def _ragged(depth_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Replace each depth by the depth of a pixel in the same row, at most two pixels away.

    This models the inexact matching of the projected pattern at edges.
    """
    shift = np.floor(0.7 * normal(rng, depth_m.shape) + 0.5).astype(np.int64)
    column = np.clip(np.arange(depth_m.shape[1]) + shift, 0, depth_m.shape[1] - 1)
    return np.take_along_axis(depth_m, column, axis=1)


def is_too_dark(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random mask [H, W] of the pixels that are too dark to be measured.

    The masked patches are about PATCH_PX pixels wide. Darker surfaces have more masked pixels.
    """
    brightness = (light[..., 0] + light[..., 1] + light[..., 2]) / 3
    patches = _enlarged(rng.random(_coarse(brightness.shape, PATCH_PX)), PATCH_PX, brightness.shape)
    return brightness < DARK * patches * (0.5 + rng.random(brightness.shape))


def matching_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return the disparity noise of a Kinect's block matching, [H, W], of unit variance.

    A Kinect matches windows of pixels, here of WINDOW_PX, so neighboring pixels share most of
    the noise.
    """
    shared = _enlarged(normal(rng, _coarse(shape, WINDOW_PX)), WINDOW_PX, shape)
    # Interpolation keeps 2/3 of the variance along each axis, hence the factor 1.5.
    return SHARED_NOISE * 1.5 * shared + OWN_NOISE * normal(rng, shape)


def _coarse(shape: tuple[int, ...], cell_px: int) -> tuple[int, int]:
    return shape[0] // cell_px + 2, shape[1] // cell_px + 2


def _enlarged(coarse: np.ndarray, cell_px: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return a coarse grid with cells of `cell_px`, interpolated to an image [H, W]."""
    v, u = np.mgrid[: shape[0], : shape[1]] / cell_px
    return _sampled(coarse[..., None], u, v)[..., 0]


def _projected(
    camera: Camera, T_world_other: np.ndarray, T_world_camera: np.ndarray, depth_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project the surface points of a depth image into the image at another camera pose.

    Sums have a fixed order, so that the result is bitwise equal on every machine.

    Args:
        camera: Intrinsics of both poses.
        T_world_other: Pose to project into, [4, 4].
        T_world_camera: Pose of the depth image, [4, 4].
        depth_m: Depth [H, W], meters.

    Returns:
        Pixel coordinates u and v in the other image, each [H, W].
    """
    ray = np.moveaxis(camera.rays(), -1, 0)
    T, S = T_world_camera, T_world_other
    world = [depth_m * _dot(T[i, :3], ray) + (T[i, 3] - S[i, 3]) for i in range(3)]
    x, y, z = (_dot(S[:3, i], world) for i in range(3))
    return x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy


def _dot(a: np.ndarray, b: np.ndarray | list) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Interpolate an image [H, W, C] bilinearly at pixels u, v, clamped to the image border."""
    height, width = image.shape[:2]
    u, v = np.clip(u, 0, width - 1.001), np.clip(v, 0, height - 1.001)
    left, top = u.astype(np.int64), v.astype(np.int64)
    fu, fv = (u - left)[..., None], (v - top)[..., None]
    texel, corner = image.reshape(-1, image.shape[2]).take, top * width + left
    upper = texel(corner, 0) * (1 - fu) + texel(corner + 1, 0) * fu
    lower = texel(corner + width, 0) * (1 - fu) + texel(corner + width + 1, 0) * fu
    return upper * (1 - fv) + lower * fv
