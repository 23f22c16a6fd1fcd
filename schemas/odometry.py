"""What another odometry of the robot says: of its wheels, an inertial unit or another camera."""

from ldo_service.schemas.message import Message
from ldo_service.schemas.pose import Pose


class OdometryPrior(Message, frozen=True, kw_only=True):
    """odometry/prior: where the robot's base was at `stamp_ns`, by the clock that stamps frames."""

    T_prior_base: Pose  # `odom` is the source's own: only the motion between two messages is used
