"""Compensation for the motion of the camera while a frame is recorded.

A rolling shutter exposes the rows of an image one after the other. A depth camera may also measure
earlier or later than the color camera. If the camera moves, both effects displace pixels. The
displacement grows with the velocity of the camera. `FrameMotion.compensated` warps color and depth
as if all pixels were recorded at the time of the middle row of color.
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.kernels import _shutter

# Pixels per cell of the grid on which the image motion is computed; it is smooth between them. The
# kernel uses the same value.
CELL_PX = 8
# Shortest interval between two frames from which a velocity is computed: 100 Hz.
MIN_INTERVAL_S = 0.01
# Fastest plausible motion of a camera. At 570 degrees/s, a rolling shutter leaves no usable image.
MAX_RAD_PER_S, MAX_M_PER_S = 10.0, 10.0


@dataclass(frozen=True, slots=True)
class ShutterTiming:
    """Readout durations of color and depth, and delay of depth after color."""

    readout_s: float = 0.0  # Time from the first to the last row of the color image.
    depth_readout_s: float = 0.0  # Time from the first to the last row of depth; 0: simultaneous.
    depth_delay_s: float = 0.0  # Time from color to depth, middle rows; negative: depth is earlier.

    def __bool__(self) -> bool:
        """Return whether the parts of a frame are recorded at different times."""
        return any(self.times_s)

    @property
    def times_s(self) -> tuple[float, float, float]:
        """Readout duration of color, readout duration of depth and delay of depth, seconds."""
        return self.readout_s, self.depth_readout_s, self.depth_delay_s

    def differs(self, other: "ShutterTiming", by_s: float) -> bool:
        """Return whether any time differs by more than `by_s` from the same time in `other`."""
        return any(abs(a - b) > by_s for a, b in zip(self.times_s, other.times_s, strict=True))

    def metrics(self) -> dict[str, float]:
        """Return the times in milliseconds, by metric name."""
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
    """Velocity of the camera during a frame, and timing of its shutter."""

    # [6] rotation in rad/s, then translation in m/s, in the camera frame: the camera is at
    # T_camera * exp(velocity * t) after the time t.
    velocity: np.ndarray
    timing: ShutterTiming  # Timing of the camera's shutter.

    @staticmethod
    def between(
        T_before: np.ndarray, T_after: np.ndarray, interval_s: float, timing: ShutterTiming
    ) -> "FrameMotion | None":
        """Return the mean motion between two camera poses [4, 4], or None.

        The result is None if the interval is below MIN_INTERVAL_S, or if the velocity is too high
        to be real. A wrong stamp or a jump of the pose causes such a velocity.
        """
        if interval_s < MIN_INTERVAL_S:
            return None
        velocity = se3.log(se3.inverse(T_before) @ T_after) / interval_s
        is_slow = se3.length(velocity[:3]) < MAX_RAD_PER_S
        is_slow &= se3.length(velocity[3:]) < MAX_M_PER_S
        return FrameMotion(velocity, timing) if is_slow else None

    def pack(self) -> dict[str, Any]:
        """Return the motion as arrays and plain values."""
        return {"velocity": self.velocity, "timing": self.timing.pack()}

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "FrameMotion":
        """Return the motion from its packed form."""
        return FrameMotion(kept["velocity"], ShutterTiming.of(kept["timing"]))

    def compensated(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame as if all its pixels were recorded at the time of the middle row.

        If the velocity is 0 or all shutter times are 0, the frame itself is returned. Where the
        frame has no data, the result is black and its depth is 0.
        """
        if not self.timing or not self.velocity.any():
            return frame
        color, depth_m = self.warped(frame.color, frame.depth_m, frame.camera)
        return replace(frame, color=color, depth_m=depth_m)

    def warped(
        self, image: np.ndarray, depth_m: np.ndarray, camera: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        """Warp an image and its depth as if all pixels were recorded at the time of the middle row.

        A pixel (u, v) of the result is read from the pixel (u, v) + f t of the input. Here f is the
        image motion of the surface point at (u, v), in pixels per second. The time t is when the
        input recorded this point, relative to the middle row of color.

        Args:
            image: Image, [H, W] or [H, W, 3].
            depth_m: Depth of the image, [H, W] meters; 0 where unknown.
            camera: Camera of the image.

        Returns:
            The warped image and the warped depth.
        """
        return _shutter.warp(
            np.ascontiguousarray(image),
            np.ascontiguousarray(depth_m),
            _intrinsics(camera),
            self.velocity,
            self.timing.times_s,
        )

    def recorded(self, image: np.ndarray, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
        """Distort a color image as the moving camera with its rolling shutter would record it.

        Args:
            image: Color image without this distortion, such as a rendering, [H, W, 3].
            depth_m: Depth of the image, [H, W] meters; 0 where unknown.
            camera: Camera of the image.
        """
        depth_m = np.ascontiguousarray(depth_m)
        flow = _shutter.image_motion(depth_m, _intrinsics(camera), self.velocity)[:2]
        # The time is that of the pixel's own row.
        height, row_s = camera.height, self.timing.readout_s / max(camera.height - 1, 1)
        v_cells = CELL_PX * np.arange(flow.shape[1]) + (CELL_PX - 1) / 2
        time_s = ((v_cells - (height - 1) / 2) * row_s).astype(np.float32)
        v, u = np.mgrid[:height, : camera.width].astype(np.float32)
        shift_u, shift_v = (_enlarged(cells, camera) for cells in flow * time_s[:, None])
        place = u - shift_u, v - shift_v
        return cv2.remap(image, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def displacement_rad(velocity: np.ndarray, timing: ShutterTiming, depth_m: float) -> float:
    """Return the largest angle, in rad, by which a velocity [6] displaces pixels of a frame.

    Args:
        velocity: Rotation in rad/s, then translation in m/s; or the difference of two velocities.
        timing: Shutter timing of the camera.
        depth_m: Median depth of the scene, meters.
    """
    speed = se3.length(velocity[:3]) + se3.length(velocity[3:]) / depth_m
    color_s = abs(timing.readout_s) / 2
    return speed * max(color_s, abs(timing.depth_readout_s) / 2 + abs(timing.depth_delay_s))


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def _enlarged(cells: np.ndarray, camera: Camera) -> np.ndarray:
    """Interpolate values of cells [h, w] to all pixels of an image, [H, W]."""
    whole = cells.shape[1] * CELL_PX, cells.shape[0] * CELL_PX
    pixels = cv2.resize(cells, whole, interpolation=cv2.INTER_LINEAR)
    return pixels[: camera.height, : camera.width]
