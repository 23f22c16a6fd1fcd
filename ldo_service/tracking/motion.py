"""Constant-velocity motion model of the camera. Conventions: `ldo_service.geometry`."""

from dataclasses import dataclass, field

import numpy as np

from ldo_service.geometry import se3

MAX_STEPS = 4.0  # Maximum extrapolation, in multiples of the last frame interval.


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """Constant-velocity motion model: the last accepted pose, and the motion that led to it."""

    T_odom_camera: np.ndarray = field(default_factory=lambda: np.eye(4))  # [4, 4]
    # Motion from the second-last pose to the last pose, [6]: rotation rad, then translation m.
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))
    interval_ns: int = 0  # Time between these two poses; 0 if unknown.
    stamp_ns: int = 0  # Stamp of the last pose.

    def predicted(self, stamp_ns: int) -> np.ndarray:
        """Return T_odom_camera [4, 4] at a stamp, extrapolated with constant velocity.

        The result is T_odom_camera * exp(twist * elapsed / interval). Here `elapsed` is the time
        from the last pose to the stamp, but at most MAX_STEPS intervals. If the stamp is not later
        than the last pose, or if the interval is unknown, elapsed / interval is 1.
        """
        elapsed_ns = stamp_ns - self.stamp_ns
        timed = elapsed_ns > 0 and self.interval_ns > 0
        steps = min(elapsed_ns / self.interval_ns, MAX_STEPS) if timed else 1.0
        return se3.orthonormalize(self.T_odom_camera @ se3.exp(self.twist * steps))

    def moved_to(self, T_odom_camera: np.ndarray, stamp_ns: int) -> "ConstantVelocity":
        """Return the model at a new pose [4, 4]; the velocity is the motion since the last pose."""
        twist = se3.log(se3.inverse(self.T_odom_camera) @ T_odom_camera)
        return ConstantVelocity(T_odom_camera, twist, stamp_ns - self.stamp_ns, stamp_ns)

    def without_velocity(self) -> "ConstantVelocity":
        """Return the model at the same pose with zero velocity, as after a loss of tracking."""
        return ConstantVelocity(self.T_odom_camera, np.zeros(6), 0, self.stamp_ns)


def image_motion_rad(T: np.ndarray, median_depth_m: float) -> float:
    """Return the image motion of a transform: rotation plus translation over depth.

    Args:
        T: Relative camera pose, [4, 4].
        median_depth_m: Median depth of the scene.

    Returns:
        Angle in rad by which T shifts the image at the median depth.
    """
    return se3.rotation_angle(T) + se3.distance(T) / median_depth_m


def image_motions_rad(T: np.ndarray, median_depth_m: np.ndarray | float) -> np.ndarray:
    """Return the image motions in rad of several transforms; see `image_motion_rad`.

    Args:
        T: Relative camera poses, [..., 4, 4].
        median_depth_m: Median depth of each scene, [...].
    """
    return se3.rotation_angles(T) + se3.distances(T) / median_depth_m
