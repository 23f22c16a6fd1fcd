"""Poses from another odometry of the robot: wheels, an inertial unit or another camera."""

from ldo_service.schemas.message import Message
from ldo_service.schemas.pose import Pose


class OdometryPrior(Message, frozen=True, kw_only=True):
    """Pose of the robot's base from another odometry, published on odometry/prior.

    stamp_ns is the time of the pose, by the same clock as the stamps of the camera frames.
    """

    # Pose in the frame of the other odometry. Only the motion between two messages is used.
    T_prior_base: Pose
