"""Color camera: motion blur, vignetting, automatic exposure, white balance and noise."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.synthetic.flat.sensor import blur, normal
from ldo_service.synthetic.optics import undistorted

# Vignetting of the green channel of an ASUS Xtion (Bonn RGB-D Dynamic, `crowd`): 0.73 in the middle
# of a side and 0.65 in the corner, where r = 1; other channels by factors on the loss.
VIGNETTING = (-0.62, 0.42, -0.15)  # Coefficients of r^2, r^4, r^6.
CHANNEL_LOSS = (1.06, 1.0, 0.88)  # Red, green, blue.
TARGET = 0.42  # Mean of an image that automatic exposure aims at.
MIN_GAIN, MAX_GAIN = 0.4, 3.0
# Fraction of the difference from the target that exposure and white balance correct in a frame.
EXPOSURE_RATE, BALANCE_RATE = 0.3, 0.1
MEMORY_FRAMES = 12  # Frames that automatic exposure and white balance start before a frame.
NOISE = 0.006  # Standard deviation at a gain of 1, fraction of full scale.


def vignetting(camera: Camera) -> np.ndarray:
    """Return the factor of each pixel and channel, [H, W, 3]."""
    half_w, half_h = camera.width / 2, camera.height / 2
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y = u - (camera.width - 1) / 2, v - (camera.height - 1) / 2
    r2 = (x * x + y * y) / (half_w * half_w + half_h * half_h)
    a, b, c = VIGNETTING
    loss = r2 * (a + r2 * (b + r2 * c))
    return np.stack([1 + factor * loss for factor in CHANNEL_LOSS], axis=-1)


def automatic_gains(means: np.ndarray) -> np.ndarray:
    """Return the gain of each channel [3] after frames with these mean colors.

    Args:
        means: Mean light of the last frames and channels, [N, 3], oldest first.
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
    """Camera poses T_world_camera [H, 4, 4] of the image rows at three times of their exposure."""

    opened: np.ndarray  # The shutter opens.
    middle: np.ndarray
    closed: np.ndarray  # The shutter closes.


def blurred(light: np.ndarray, depth_m: np.ndarray, camera: Camera, rows: RowPoses) -> np.ndarray:
    """Return the light [H, W, 3] averaged over the exposure of each row.

    A pixel averages the sharp image along the path of its surface. Surfaces that the motion
    uncovers are not modeled.
    """
    return blur(light, *exposure_motion_px(depth_m, camera, rows))


def exposure_motion_px(
    depth_m: np.ndarray, camera: Camera, rows: RowPoses
) -> tuple[np.ndarray, np.ndarray]:
    """Return the image motion in u and v during the exposure, each [H, W]."""
    start = projected_px(depth_m, camera, rows.middle, rows.opened)
    end = projected_px(depth_m, camera, rows.middle, rows.closed)
    return end[0] - start[0], end[1] - start[1]


def projected_px(
    depth_m: np.ndarray, camera: Camera, T_world_camera: np.ndarray, T_world_other: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels u and v, each [H, W], of all surfaces from another pose of their row.

    The projection ignores lens distortion, because only differences of pixels are used.

    Args:
        depth_m: Depth [H, W], meters.
        camera: Intrinsics.
        T_world_camera: Poses [H, 4, 4] of the rows of depth_m.
        T_world_other: Poses [H, 4, 4] of the rows to project into.
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
    """Return the light [H, W, 3] with the gains [3] of the channels and noise."""
    noise = NOISE * (0.5 + 0.5 * gains) * normal(rng, light.shape)
    return gains * light + noise
