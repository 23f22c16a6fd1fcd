"""Reference of the compensation of the camera's motion during a frame, in NumPy and OpenCV."""

import cv2
import numpy as np

from ldo_service.calibration.shutter import FrameMotion
from ldo_service.geometry import Camera

CELL_PX = 8
MAX_ROW_SHIFT = 0.5


def warped(
    image: np.ndarray, depth_m: np.ndarray, camera: Camera, motion: FrameMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Return color and depth as if the camera recorded all pixels at the same time.

    This is the time of the middle row of the color image. Color is [H, W] or [H, W, 3].
    Depth is [H, W], meters.
    """
    flow, z_per_s = image_motion(depth_m, camera, motion.velocity)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    timing = motion.timing
    color_s = row_times_s(flow[1], timing.readout_s, 0.0, camera)
    shift_u, shift_v = (enlarged(values, camera) for values in flow * color_s)
    moved, is_valid = interpolated(image, u + shift_u, v + shift_v)
    moved[~is_valid] = 0
    depth_s = row_times_s(flow[1], timing.depth_readout_s, timing.depth_delay_s, camera)
    shift_u, shift_v = (enlarged(values, camera) for values in flow * depth_s)
    nearest = cv2.remap(depth_m, u + shift_u, v + shift_v, cv2.INTER_NEAREST)
    ratio = 1.0 - enlarged(z_per_s * depth_s, camera)
    return moved, np.where(nearest > 0, nearest * ratio, np.float32(0.0))


def interpolated(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an image interpolated at (x, y) [H, W], and where only valid pixels contribute."""
    height, width = image.shape[:2]
    is_black = (image if image.ndim == 2 else image.max(axis=2)) == 0
    is_inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    x, y = np.where(is_inside, x, 0.0), np.where(is_inside, y, 0.0)
    total, is_valid = np.zeros(image.shape), is_inside
    for i, weight_v in ((np.floor(y), 1.0 - y % 1), (np.floor(y) + 1, y % 1)):
        for j, weight_u in ((np.floor(x), 1.0 - x % 1), (np.floor(x) + 1, x % 1)):
            weight = weight_u * weight_v
            where = np.minimum(i, height - 1).astype(int), np.minimum(j, width - 1).astype(int)
            total += image[where] * (weight if image.ndim == 2 else weight[..., None])
            is_valid = is_valid & ~((weight > 0) & is_black[where])
    return np.floor(total + 0.5).astype(np.uint8), is_valid


def image_motion(
    depth_m: np.ndarray, camera: Camera, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the image motion [2, h, w] in pixels per second, and the change of depth [h, w]."""
    u, v = cells(camera)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    inverse = inverse_depth(depth_m, v.shape[0], u.shape[1])
    rx, ry, rz, tx, ty, tz = velocity
    z_per_s = -(tz * inverse + rx * y - ry * x)
    flow_u = camera.fx * (-(tx * inverse + ry - rz * y) - x * z_per_s)
    flow_v = camera.fy * (-(ty * inverse + rz * x - rx) - y * z_per_s)
    return np.stack([flow_u, flow_v]), z_per_s


def row_times_s(flow_v: np.ndarray, readout_s: float, delay_s: float, camera: Camera) -> np.ndarray:
    """Return when the surface points of the cells were recorded, [h, w] seconds."""
    row_s = readout_s / max(camera.height - 1, 1)
    _, v = cells(camera)
    shift = np.clip(flow_v * row_s, -MAX_ROW_SHIFT, MAX_ROW_SHIFT)
    return ((v - (camera.height - 1) / 2) * row_s + delay_s) / (1.0 - shift)


def inverse_depth(depth_m: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the inverse depth [height, width] of cells; unknown cells have the median depth."""
    sampled = depth_m[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]
    known = np.zeros((height, width), np.float32)
    known[: sampled.shape[0], : sampled.shape[1]] = sampled
    if not known.any():
        return known
    return 1.0 / np.where(known > 0, known, np.median(known[known > 0]))


def enlarged(values: np.ndarray, camera: Camera) -> np.ndarray:
    """Interpolate values of cells [h, w] to all pixels, [H, W] float32."""
    whole = values.shape[1] * CELL_PX, values.shape[0] * CELL_PX
    pixels = cv2.resize(values.astype(np.float32), whole, interpolation=cv2.INTER_LINEAR)
    return pixels[: camera.height, : camera.width]


def cells(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the image coordinates u [1, w] and v [h, 1] of the centers of the cells."""
    width, height = -(-camera.width // CELL_PX), -(-camera.height // CELL_PX)
    u, v = (CELL_PX * np.arange(size) + (CELL_PX - 1) / 2 for size in (width, height))
    return u[None], v[:, None]
