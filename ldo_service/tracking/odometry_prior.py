"""Odometry prior: poses from another odometry, such as wheels, an inertial unit or another camera.

The other odometry has its own coordinate frame, so only the motion between two of its poses is
used. This motion yields an initial guess, which the images then confirm or refute. If the other
odometry restarts or jumps, a new session begins. The motion between two sessions is unknown.
Conventions: `ldo_service.geometry`.
"""

from bisect import bisect_left
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from operator import attrgetter
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3

# Number of poses kept: those of a third of a second at 200 Hz. Tracking a frame takes less time.
KEPT = 64


@dataclass(frozen=True, slots=True)
class PriorConfig:
    """Settings of the odometry prior."""

    # Maximum time between two poses that are interpolated; over a longer time, the path between the
    # poses is not straight.
    max_gap_s: float = 0.25
    # Maximum time of extrapolation past the newest pose: one period of wheel odometry at 20 Hz.
    max_extrapolation_s: float = 0.05
    # Speed between two poses above which the motion is a jump; tracking cannot follow a faster
    # camera.
    max_speed_m_per_s: float = 10.0
    # Turn rate between two poses above which the motion is a jump; a hand turns a camera at up to
    # 10 rad/s.
    max_turn_rad_per_s: float = 20.0
    # If a stamp is earlier than the last one by more than this, the source has restarted. Smaller
    # differences are jitter.
    restart_after_s: float = 1.0
    # Maximum time of dead reckoning since the last OK frame. At 0.5 m/s, a drift of 2 % is then
    # 30 cm.
    max_dead_reckoning_s: float = 30.0

    def __post_init__(self) -> None:
        times_s = self.max_gap_s, self.restart_after_s, self.max_dead_reckoning_s
        limits = *times_s, self.max_speed_m_per_s, self.max_turn_rad_per_s
        if not all(limit > 0 for limit in limits):  # NaN fails too.
            raise ConfigError(
                named(
                    self,
                    "max_gap_s",
                    "max_speed_m_per_s",
                    "max_turn_rad_per_s",
                    "restart_after_s",
                    "max_dead_reckoning_s",
                )
                + " must be positive."
            )
        if not self.max_extrapolation_s >= 0:
            raise ConfigError(
                f"PriorConfig.max_extrapolation_s={self.max_extrapolation_s:g} must not be "
                "negative."
            )


class PriorCheck(StrEnum):
    """Outcome of adding a pose to the buffer; each value is a phrase for a log line."""

    FOLLOWS = "follows the previous pose"
    LATE = "is not later than the previous pose, and is dropped"
    BROKEN = "contains NaN or infinity, and is dropped"
    RESTARTED = "is much earlier than the previous pose, so its source has restarted"
    JUMPED = "is too far from the previous pose for the time between them, so its source has jumped"


@dataclass(frozen=True, slots=True)
class StampedPose:
    """Pose of the robot's base in the coordinate frame of the odometry prior, at one time."""

    stamp_ns: int
    T_prior_base: np.ndarray  # [4, 4]


@dataclass(frozen=True, slots=True)
class PriorPose:
    """Camera pose in the coordinate frame of the odometry prior, at one time."""

    stamp_ns: int
    T_prior_camera: np.ndarray  # [4, 4]
    session: int  # Number of the session; motion between poses of different sessions is unknown.


@dataclass(frozen=True, slots=True)
class OdometryPriorBuffer:
    """Last poses of the odometry prior, all after the last restart or jump of their source."""

    poses: tuple[StampedPose, ...] = ()  # Ascending by stamp.
    session: int = 0  # Number of the session; restarts and jumps increase it.

    def added(
        self, stamp_ns: int, T_prior_base: np.ndarray, config: PriorConfig
    ) -> tuple["OdometryPriorBuffer", PriorCheck]:
        """Return the buffer with a new pose [4, 4], and the outcome of the checks on that pose.

        A pose that is late or holds NaN or infinity is dropped. After a restart or a jump, the new
        pose begins a new session.
        """
        pose = StampedPose(stamp_ns, T_prior_base)
        check = self._check(pose, config)
        if check in (PriorCheck.LATE, PriorCheck.BROKEN):
            return self, check
        if check is PriorCheck.FOLLOWS:
            return replace(self, poses=(*self.poses[1 - KEPT :], pose)), check
        return OdometryPriorBuffer((pose,), self.session + 1), check

    def _check(self, pose: StampedPose, config: PriorConfig) -> PriorCheck:
        if not np.isfinite(pose.T_prior_base).all():
            return PriorCheck.BROKEN
        if not self.poses:
            return PriorCheck.FOLLOWS
        last = self.poses[-1]
        elapsed_s = (pose.stamp_ns - last.stamp_ns) * 1e-9
        if elapsed_s <= 0:
            return PriorCheck.RESTARTED if -elapsed_s > config.restart_after_s else PriorCheck.LATE
        moved = se3.inverse(last.T_prior_base) @ pose.T_prior_base
        is_possible = (
            np.linalg.norm(moved[:3, 3]) <= config.max_speed_m_per_s * elapsed_s
            and se3.rotation_angle(moved) <= config.max_turn_rad_per_s * elapsed_s
        )
        return PriorCheck.FOLLOWS if is_possible else PriorCheck.JUMPED

    def at(self, stamp_ns: int, T_base_camera: np.ndarray, config: PriorConfig) -> PriorPose | None:
        """Return the camera pose at a stamp, or None if the buffer does not cover that time.

        Args:
            stamp_ns: Time of the frame.
            T_base_camera: Pose of the camera on the robot, [4, 4].
            config: Settings.
        """
        following = bisect_left(self.poses, stamp_ns, key=attrgetter("stamp_ns"))
        if following < len(self.poses):
            T_prior_base = self._between(following, stamp_ns, config)
        else:
            T_prior_base = self._beyond(stamp_ns, config)
        if T_prior_base is None:
            return None
        return PriorPose(stamp_ns, T_prior_base @ T_base_camera, self.session)

    def _between(self, following: int, stamp_ns: int, config: PriorConfig) -> np.ndarray | None:
        after = self.poses[following]
        if after.stamp_ns == stamp_ns:
            return after.T_prior_base
        if following == 0:
            return None
        before = self.poses[following - 1]
        is_near = after.stamp_ns - before.stamp_ns <= 1e9 * config.max_gap_s
        return interpolated(before, after, stamp_ns) if is_near else None

    def _beyond(self, stamp_ns: int, config: PriorConfig) -> np.ndarray | None:
        """Extrapolate the pose [4, 4] past the newest pose; return None if the stamp is too late.

        The velocity is the motion from the earliest pose within `max_gap_s` to the newest one. Two
        poses closer in time would amplify their noise.
        """
        if not self.poses:
            return None
        newest = self.poses[-1]
        if stamp_ns - newest.stamp_ns > 1e9 * config.max_extrapolation_s:
            return None
        earliest_ns = newest.stamp_ns - round(1e9 * config.max_gap_s)
        base = self.poses[bisect_left(self.poses, earliest_ns, key=attrgetter("stamp_ns"))]
        return None if base is newest else interpolated(base, newest, stamp_ns)

    def pack(self) -> dict[str, Any]:
        """Return the buffer as arrays and plain values."""
        return {
            "stamps_ns": [pose.stamp_ns for pose in self.poses],
            "T_prior_base": [pose.T_prior_base for pose in self.poses],
            "stretch": self.session,
        }

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "OdometryPriorBuffer":
        """Return the buffer from its packed form."""
        pairs = zip(kept["stamps_ns"], kept["T_prior_base"], strict=True)
        return OdometryPriorBuffer(tuple(StampedPose(*pair) for pair in pairs), kept["stretch"])


def interpolated(a: StampedPose, b: StampedPose, stamp_ns: int) -> np.ndarray:
    """Interpolate between two poses: rotation on the shortest arc, translation on a line.

    Args:
        a: The earlier pose.
        b: The later pose.
        stamp_ns: Time of the result. If it is after b, the motion is extrapolated.

    Returns:
        Pose [4, 4] of the robot's base in the coordinate frame of the odometry prior.
    """
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    T = se3.interpolate(a.T_prior_base[None], b.T_prior_base[None], np.array([share]))
    return T[0]


@dataclass(frozen=True, slots=True)
class DeadReckoningStart:
    """Start of dead reckoning: the last OK frame, with its poses by tracking and by the prior."""

    T_odom_camera: np.ndarray  # [4, 4]
    reading: PriorPose  # Pose of the same frame in the prior.

    def dead_reckon(self, now: PriorPose, config: PriorConfig) -> np.ndarray | None:
        """Return T_odom_camera [4, 4] at `now`: the start pose, moved as the prior has moved since.

        T_odom_now = T_odom_start * inverse(T_prior_start) * T_prior_now

        Return None if the prior has begun another session since the start, or if more than
        `config.max_dead_reckoning_s` seconds have passed.
        """
        then, elapsed_s = self.reading, (now.stamp_ns - self.reading.stamp_ns) * 1e-9
        if now.session != then.session or not 0 <= elapsed_s <= config.max_dead_reckoning_s:
            return None
        moved = se3.inverse(then.T_prior_camera) @ now.T_prior_camera
        return se3.orthonormalize(self.T_odom_camera @ moved)

    def pack(self) -> dict[str, Any]:
        """Return the start as arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "DeadReckoningStart":
        """Return the start from its packed form."""
        return DeadReckoningStart(kept["T_odom_camera"], PriorPose(**kept["reading"]))
