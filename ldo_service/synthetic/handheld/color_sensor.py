"""Color camera: motion blur, vignetting, automatic exposure, white balance and noise."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.synthetic.flat.sensor import blur, normal
from ldo_service.synthetic.optics import undistorted

# Vignetting of the green channel of an ASUS Xtion (Bonn RGB-D Dynamic, `crowd`). The radius r is
# 1 in the corners. The factor on the light is 0.65 there and 0.73 in the middle of the left side.
VIGNETTING = (-0.62, 0.42, -0.15)  # Coefficients of r^2, r^4, r^6 in (factor - 1).
CHANNEL_LOSS = (1.06, 1.0, 0.88)  # (factor - 1) of red, green and blue, relative to green.
TARGET = 0.42  # Target of automatic exposure for the mean gray value, 0..1.
MIN_GAIN, MAX_GAIN = 0.4, 3.0
# Fraction of the difference from the target that exposure and white balance correct per frame.
EXPOSURE_RATE, BALANCE_RATE = 0.3, 0.1
# Number of earlier frames over which the exposure and white balance of a frame are simulated.
MEMORY_FRAMES = 12
NOISE = 0.006  # Standard deviation at a gain of 1, as a fraction of full scale.


def vignetting(camera: Camera) -> np.ndarray:
    """Return the factor by which vignetting reduces the light, by pixel and channel [H, W, 3]."""
    half_w, half_h = camera.width / 2, camera.height / 2
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y = u - (camera.width - 1) / 2, v - (camera.height - 1) / 2
    r2 = (x * x + y * y) / (half_w * half_w + half_h * half_h)
    a, b, c = VIGNETTING
    loss = r2 * (a + r2 * (b + r2 * c))
    return np.stack([1 + factor * loss for factor in CHANNEL_LOSS], axis=-1)


def automatic_gains(means: np.ndarray) -> np.ndarray:
    """Return the channel gains [3] that exposure and white balance have after N frames.

    Args:
        means: Mean light of each channel in each frame, [N, 3], oldest first; N is at least 1.
    """
    gain, balance = None, None
    for mean in means:
        gray = (mean[0] + mean[1] + mean[2]) / 3
        wanted = min(max(TARGET / gray, MIN_GAIN), MAX_GAIN)
        neutral = np.sqrt(gray / mean)
        gain = wanted if gain is None else gain + EXPOSURE_RATE * (wanted - gain)
        balance = neutral if balance is None else balance + BALANCE_RATE * (neutral - balance)
    assert gain is not None
    assert balance is not None
    return gain * balance


@dataclass(frozen=True, slots=True)
class RowPoses:
    """Poses T_world_camera of all H image rows at three times of the exposure, each [H, 4, 4]."""

    opened: np.ndarray  # Poses at the start of the exposure.
    middle: np.ndarray  # Poses at the middle of the exposure.
    closed: np.ndarray  # Poses at the end of the exposure.


def blurred(light: np.ndarray, depth_m: np.ndarray, camera: Camera, rows: RowPoses) -> np.ndarray:
    """Return the light [H, W, 3] averaged over the exposure of each row.

    Each pixel is the mean of the sharp image along the path of its surface point through the image.
    Surfaces that the motion uncovers are not modeled.
    """
    return blur(light, *exposure_motion_px(depth_m, camera, rows))


def exposure_motion_px(
    depth_m: np.ndarray, camera: Camera, rows: RowPoses
) -> tuple[np.ndarray, np.ndarray]:
    """Return the image motion in u and v during the exposure, each [H, W] pixels."""
    start = projected_px(depth_m, camera, rows.middle, rows.opened)
    end = projected_px(depth_m, camera, rows.middle, rows.closed)
    return end[0] - start[0], end[1] - start[1]


def projected_px(
    depth_m: np.ndarray, camera: Camera, T_world_camera: np.ndarray, T_world_other: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project the surface point of each pixel into a second view of the same image row.

    The projection ignores lens distortion, because callers use only coordinate differences.

    Args:
        depth_m: Depth [H, W] of the first view, meters.
        camera: Intrinsics of both views.
        T_world_camera: Poses [H, 4, 4] of the rows of the first view.
        T_world_other: Poses [H, 4, 4] of the rows of the second view.

    Returns:
        Pixel coordinates u and v in the second view, each [H, W].
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y = undistorted(camera, u, v)
    own = (x * depth_m, y * depth_m, depth_m)
    T, S = T_world_camera[:, None], T_world_other[:, None]
    world = [
        T[..., i, 0] * own[0] + T[..., i, 1] * own[1] + T[..., i, 2] * own[2]
        + (T[..., i, 3] - S[..., i, 3])
        for i in range(3)
    ]  # fmt: skip
    across, down, z = (
        S[..., 0, i] * world[0] + S[..., 1, i] * world[1] + S[..., 2, i] * world[2]
        for i in range(3)
    )
    z = np.maximum(z, 1e-3)
    return across / z * camera.fx + camera.cx, down / z * camera.fy + camera.cy


def recorded(light: np.ndarray, gains: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Apply the gains [3] of the channels to the light [H, W, 3] and add sensor noise."""
    noise = NOISE * (0.5 + 0.5 * gains) * normal(rng, light.shape)
    return gains * light + noise
