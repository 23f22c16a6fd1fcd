"""Constant-velocity motion of the camera. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass, field

import numpy as np

from ldo_service.geometry import se3

MAX_STEPS = 4.0  # extrapolate over at most this many of the last interval


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """The last trusted pose, and the twist that led to it over `interval_ns`."""

    T_odom_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))
    interval_ns: int = 0
    stamp_ns: int = 0

    def predicted(self, stamp_ns: int) -> np.ndarray:
        """T_odom_camera [4, 4] at a stamp: T * exp(twist * elapsed / interval).

        Frames without usable stamps count as one interval apart.
        """
        elapsed_ns = stamp_ns - self.stamp_ns
        timed = elapsed_ns > 0 and self.interval_ns > 0
        steps = min(elapsed_ns / self.interval_ns, MAX_STEPS) if timed else 1.0
        return se3.orthonormalize(self.T_odom_camera @ se3.exp(self.twist * steps))

    def moved_to(self, T_odom_camera: np.ndarray, stamp_ns: int) -> "ConstantVelocity":
        twist = se3.log(se3.inverse(self.T_odom_camera) @ T_odom_camera)
        return ConstantVelocity(T_odom_camera, twist, stamp_ns - self.stamp_ns, stamp_ns)

    def without_velocity(self) -> "ConstantVelocity":
        """The same place without velocity: after a loss, nothing is known of it."""
        return ConstantVelocity(self.T_odom_camera, np.zeros(6), 0, self.stamp_ns)


def image_motion_rad(T: np.ndarray, median_depth_m: float) -> float:
    """How far T [4, 4] shifts the image of a scene at the median depth, in rad."""
    return float(image_motions_rad(T, median_depth_m))


def image_motions_rad(T: np.ndarray, median_depth_m: np.ndarray | float) -> np.ndarray:
    """Shifts [...] in rad of T [..., 4, 4] at median_depth_m [...]."""
    return se3.rotation_angles(T) + se3.distances(T) / median_depth_m
