"""Compensation of the camera's motion while a frame is recorded.

A rolling shutter exposes the rows of an image one after the other, and a depth camera measures at
another time than the color camera. Both errors grow with the velocity of the camera.
`FrameMotion.compensated` moves color and depth to where a camera would have recorded them that
takes the whole frame at once, at the time of its middle row. Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.geometry.frames import brightest

# Pixels per cell of the grid on which the image motion is computed; it is smooth between them.
CELL_PX = 8
# Shortest interval between two frames from which a velocity is computed: 100 Hz.
MIN_INTERVAL_S = 0.01
# Fastest motion of a camera: 570 degrees/s, of which a rolling shutter leaves no image.
MAX_RAD_PER_S, MAX_M_PER_S = 10.0, 10.0
MAX_ROW_SHIFT = 0.5  # Image motion in rows per row of the readout; the image would fold beyond 1.


@dataclass(frozen=True, slots=True)
class ShutterTiming:
    """Times at which a camera records the parts of a frame."""

    readout_s: float = 0.0  # Time from the first to the last row of the color image.
    depth_readout_s: float = 0.0  # The same for depth; 0 if all rows are measured at once.
    depth_delay_s: float = 0.0  # Time from color to depth, middle rows; negative: depth is earlier.

    def __bool__(self) -> bool:
        """Return whether the parts of a frame are recorded at different times."""
        return any(self.times_s)

    @property
    def times_s(self) -> tuple[float, float, float]:
        """Readout of color, readout of depth and delay of depth."""
        return self.readout_s, self.depth_readout_s, self.depth_delay_s

    def differs(self, other: "ShutterTiming", by_s: float) -> bool:
        """Return whether a time differs from that of another timing by more than `by_s`."""
        return any(abs(a - b) > by_s for a, b in zip(self.times_s, other.times_s, strict=True))

    def metrics(self) -> dict[str, float]:
        """Return the times by name, ms."""
        return {name.removesuffix("_s") + "_ms": 1e3 * t for name, t in self.pack().items()}

    def pack(self) -> dict[str, float]:
        """Return the fields by name."""
        return asdict(self)

    @staticmethod
    def of(values: Mapping[str, Any]) -> "ShutterTiming":
        """Restore a timing from its fields by name; missing fields are zero."""
        names = ("readout_s", "depth_readout_s", "depth_delay_s")
        return ShutterTiming(*(float(values.get(name, 0.0)) for name in names))


@dataclass(frozen=True, eq=False, slots=True)
class FrameMotion:
    """Velocity of the camera while it recorded a frame, and the timing of the recording."""

    # [6] rotation in rad/s, then translation in m/s, in the camera frame: the camera is at
    # T_camera * exp(velocity * t) after the time t.
    velocity: np.ndarray
    timing: ShutterTiming

    @staticmethod
    def between(
        T_before: np.ndarray, T_after: np.ndarray, interval_s: float, timing: ShutterTiming
    ) -> "FrameMotion | None":
        """Return the mean motion between two camera poses [4, 4]; None if it is implausible.

        A wrong stamp or a jump of the pose would give a velocity that no camera has.
        """
        if interval_s < MIN_INTERVAL_S:
            return None
        velocity = se3.log(se3.inverse(T_before) @ T_after) / interval_s
        is_slow = np.linalg.norm(velocity[:3]) < MAX_RAD_PER_S
        is_slow &= np.linalg.norm(velocity[3:]) < MAX_M_PER_S
        return FrameMotion(velocity, timing) if is_slow else None

    def pack(self) -> dict[str, Any]:
        """Return the motion as arrays and plain values."""
        return {"velocity": self.velocity, "timing": self.timing.pack()}

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "FrameMotion":
        """Return the motion from its packed form."""
        return FrameMotion(kept["velocity"], ShutterTiming.of(kept["timing"]))

    def compensated(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame as recorded at once; without motion or timing, the frame itself.

        Pixels that the frame does not show become black, and their depth 0.
        """
        if not self.timing or not self.velocity.any():
            return frame
        color, depth_m = self.warped(frame.color, frame.depth_m, frame.camera)
        return replace(frame, color=color, depth_m=depth_m)

    def warped(
        self, image: np.ndarray, depth_m: np.ndarray, camera: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return an image [H, W] or [H, W, 3] and its depth [H, W] in meters as recorded at once.

        A pixel (u, v) of the result is read from (u, v) + f t, where f is the image motion per
        second of the surface point at (u, v), and t is the time at which its row was recorded.
        """
        flow, z_per_s = self._image_motion(depth_m, camera)
        u, v = _grid(camera)
        size = camera.width, camera.height

        def place(shift_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return u + _enlarged(shift_px[0], size), v + _enlarged(shift_px[1], size)

        color_s = _row_times_s(flow[1], self.timing.readout_s, 0.0, camera)
        color_place = place(flow * color_s)
        moved = cv2.remap(image, *color_place, cv2.INTER_LINEAR)
        # A pixel that mixes with an invalid one, which is black, is invalid.
        is_valid = (image if image.ndim == 2 else brightest(image)) > 0
        if not is_valid.all():
            share = cv2.remap(is_valid.astype(np.uint8) * 255, *color_place, cv2.INTER_LINEAR)
            moved = cv2.bitwise_and(moved, moved, mask=cv2.inRange(share, 255, 255))
        timing = self.timing
        depth_s = _row_times_s(flow[1], timing.depth_readout_s, timing.depth_delay_s, camera)
        nearest = cv2.remap(depth_m, *place(flow * depth_s), cv2.INTER_NEAREST)
        is_known = nearest > 0
        # Relative change of the depth since the middle of the frame.
        ratio = 1.0 - _enlarged(z_per_s * depth_s, size)
        return moved, np.where(is_known, nearest * ratio, np.float32(0.0))

    def recorded(self, image: np.ndarray, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
        """Return a color image [H, W, 3] of the whole frame at once as the camera records it.

        Args:
            image: Color image, such as a rendering.
            depth_m: Its depth, [H, W] meters; 0 where unknown.
            camera: Camera of the image.
        """
        flow, _ = self._image_motion(depth_m, camera)
        # The time is that of the pixel's own row.
        shift_px = flow * _row_times_s(np.float32(0.0), self.timing.readout_s, 0.0, camera)
        size = camera.width, camera.height
        grid_u, grid_v = _grid(camera)
        place = grid_u - _enlarged(shift_px[0], size), grid_v - _enlarged(shift_px[1], size)
        return cv2.remap(image, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _image_motion(self, depth_m: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the motion of the surface on a grid of cells.

        Returns:
            The image motion [2, h, w] in pixels per second, and the relative change of depth [h, w]
            per second.
        """
        u, v = _cells(camera)
        x = (u - np.float32(camera.cx)) / np.float32(camera.fx)
        y = (v - np.float32(camera.cy)) / np.float32(camera.fy)
        inverse = _inverse_depth(depth_m, v.shape[0], u.shape[1])
        rx, ry, rz, tx, ty, tz = self.velocity.astype(np.float32)
        # A point X has the velocity -(t + r x X) in the camera frame.
        z_per_s = -(tz * inverse + rx * y - ry * x)
        flow_u = np.float32(camera.fx) * (-(tx * inverse + ry - rz * y) - x * z_per_s)
        flow_v = np.float32(camera.fy) * (-(ty * inverse + rz * x - rx) - y * z_per_s)
        return np.stack([flow_u, flow_v]), z_per_s


def _row_times_s(
    flow_v: np.ndarray | np.float32, readout_s: float, delay_s: float, camera: Camera
) -> np.ndarray:
    """Return when the surface points of the cells were recorded, [h, w] seconds.

    A point that moves downwards is recorded in a later row than the one in which it is in the
    middle of the frame, and the row is recorded later in turn.

    Args:
        flow_v: Image motion of the points in v, [h, w] or scalar, pixels per second.
        readout_s: Time from the first to the last row.
        delay_s: Time of the middle row.
        camera: Camera of the image.
    """
    row_s = readout_s / max(camera.height - 1, 1)
    _, v = _cells(camera)
    shift = np.clip(flow_v * np.float32(row_s), -MAX_ROW_SHIFT, MAX_ROW_SHIFT)
    at_once_s = (v - np.float32((camera.height - 1) / 2)) * np.float32(row_s) + np.float32(delay_s)
    return at_once_s / (1.0 - shift)


def displacement_rad(velocity: np.ndarray, timing: ShutterTiming, depth_m: float) -> float:
    """Return by how much a velocity [6] moves the image at most during a frame, in rad.

    Args:
        velocity: Rotation in rad/s and translation in m/s; or a difference of two velocities.
        timing: Timing of the camera.
        depth_m: Median depth of the scene.
    """
    speed = np.linalg.norm(velocity[:3]) + np.linalg.norm(velocity[3:]) / depth_m
    color_s = abs(timing.readout_s) / 2
    return float(speed) * max(color_s, abs(timing.depth_readout_s) / 2 + abs(timing.depth_delay_s))


def _inverse_depth(depth_m: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the inverse depth [height, width] of the cells, 1/m; the median where unknown."""
    sampled = depth_m[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]
    cells = np.zeros((height, width), np.float32)
    cells[: sampled.shape[0], : sampled.shape[1]] = sampled
    is_known = cells > 0
    if not is_known.any():
        return cells
    usual_m = np.median(cells[is_known])
    return np.float32(1.0) / np.where(is_known, cells, usual_m)


def _enlarged(cells: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Interpolate values of cells [h, w] to all pixels of an image of `size` (W, H)."""
    whole = cells.shape[1] * CELL_PX, cells.shape[0] * CELL_PX
    pixels = cv2.resize(cells, whole, interpolation=cv2.INTER_LINEAR)
    return pixels[: size[1], : size[0]]


@lru_cache(maxsize=4)
def _cells(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the image coordinates u [1, w] and v [h, 1] of the centers of the cells."""
    width, height = -(-camera.width // CELL_PX), -(-camera.height // CELL_PX)
    center = (CELL_PX - 1) / 2
    u = (CELL_PX * np.arange(width) + center).astype(np.float32)
    v = (CELL_PX * np.arange(height) + center).astype(np.float32)
    return u[None, :], v[:, None]


@lru_cache(maxsize=4)
def _grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    return u, v
