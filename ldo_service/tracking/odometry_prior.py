"""Where another odometry has the camera: that of wheels, an inertial unit or another camera.

Its poses are in a frame of its own, so only the motion between two of them says anything, and only
as a guess that the images then confirm or refute. A source that starts again or jumps begins a new
stretch; between two stretches nothing is known. Conventions: `ldo_service.geometry`.
"""

from bisect import bisect_left
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from operator import attrgetter
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3

KEPT = 64  # poses: a third of a second at 200 Hz, and frames are not tracked later than that


@dataclass(frozen=True, slots=True)
class PriorConfig:
    max_gap_s: float = 0.25  # between two poses: over a longer time a path is no straight line
    max_extrapolation_s: float = 0.05  # past the newest pose, at its velocity: 20 Hz, as wheels do
    max_speed_m_per_s: float = 10.0  # between two poses; no camera is followed so fast: a jump
    max_turn_rad_per_s: float = 20.0  # the same; a hand turns a camera at up to 10
    restart_after_s: float = 1.0  # a stamp so much earlier is no jitter: the source began again
    max_carried_s: float = 30.0  # since the last OK frame: 2 % of drift at 0.5 m/s are 30 cm then

    def __post_init__(self) -> None:
        times_s = self.max_gap_s, self.restart_after_s, self.max_carried_s
        limits = *times_s, self.max_speed_m_per_s, self.max_turn_rad_per_s
        if not all(limit > 0 for limit in limits):  # NaN fails too
            raise ConfigError(
                named(
                    self,
                    "max_gap_s",
                    "max_speed_m_per_s",
                    "max_turn_rad_per_s",
                    "restart_after_s",
                    "max_carried_s",
                )
                + ": limits must be positive."
            )
        if not self.max_extrapolation_s >= 0:
            raise ConfigError(
                f"max_extrapolation_s={self.max_extrapolation_s:g}: must be 0 or more."
            )


class PriorCheck(StrEnum):
    """On a pose that was added."""

    FOLLOWS = "follows the last one"
    LATE = "has a stamp that is not after the last one's, and is left out"
    BROKEN = "holds NaN or infinity, and is left out"
    RESTARTED = "has a much earlier stamp: its source has started again"
    JUMPED = "is too far from the last one for the time between: its source has jumped"


@dataclass(frozen=True, slots=True)
class StampedPose:
    stamp_ns: int
    T_prior_base: np.ndarray  # [4, 4]


@dataclass(frozen=True, slots=True)
class PriorPose:
    """Where the other odometry had the camera at one time. Compares within its stretch alone."""

    stamp_ns: int
    T_prior_camera: np.ndarray  # [4, 4]
    session: int


@dataclass(frozen=True, slots=True)
class OdometryPriorBuffer:
    """The last poses of the current stretch, ascending."""

    poses: tuple[StampedPose, ...] = ()
    session: int = 0

    def added(
        self, stamp_ns: int, T_prior_base: np.ndarray, config: PriorConfig
    ) -> tuple["OdometryPriorBuffer", PriorCheck]:
        """With one pose [4, 4] more, if it can be used."""
        pose = StampedPose(stamp_ns, T_prior_base)
        verdict = self._judged(pose, config)
        if verdict in (PriorCheck.LATE, PriorCheck.BROKEN):
            return self, verdict
        if verdict is PriorCheck.FOLLOWS:
            return replace(self, poses=(*self.poses[1 - KEPT :], pose)), verdict
        return OdometryPriorBuffer((pose,), self.session + 1), verdict

    def _judged(self, pose: StampedPose, config: PriorConfig) -> PriorCheck:
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
        """The camera [4, 4] at a stamp; None where the poses do not reach it."""
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
        """Over a long base, where there is one: the noise of two near poses would be multiplied."""
        if not self.poses:
            return None
        newest = self.poses[-1]
        if stamp_ns - newest.stamp_ns > 1e9 * config.max_extrapolation_s:
            return None
        earliest_ns = newest.stamp_ns - round(1e9 * config.max_gap_s)
        base = self.poses[bisect_left(self.poses, earliest_ns, key=attrgetter("stamp_ns"))]
        return None if base is newest else interpolated(base, newest, stamp_ns)

    def pack(self) -> dict[str, Any]:
        """Arrays and plain values."""
        return {
            "stamps_ns": [pose.stamp_ns for pose in self.poses],
            "T_prior_base": [pose.T_prior_base for pose in self.poses],
            "stretch": self.session,
        }

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "OdometryPriorBuffer":
        pairs = zip(kept["stamps_ns"], kept["T_prior_base"], strict=True)
        return OdometryPriorBuffer(tuple(StampedPose(*pair) for pair in pairs), kept["stretch"])


def interpolated(a: StampedPose, b: StampedPose, stamp_ns: int) -> np.ndarray:
    """T [4, 4] at a stamp: rotation on the shortest arc, translation on a line; also beyond b."""
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    T = se3.interpolate(a.T_prior_base[None], b.T_prior_base[None], np.array([share]))
    return T[0]


@dataclass(frozen=True, slots=True)
class DeadReckoningStart:
    """An OK frame: where it was taken, and where the other odometry had it."""

    T_odom_camera: np.ndarray  # [4, 4]
    reading: PriorPose

    def dead_reckon(self, now: PriorPose, config: PriorConfig) -> np.ndarray | None:
        """T_odom_camera [4, 4] by the motion since; None over two stretches, or too long after.

        T_odom_now = T_odom_then * inverse(T_prior_then) * T_prior_now
        """
        then, elapsed_s = self.reading, (now.stamp_ns - self.reading.stamp_ns) * 1e-9
        if now.session != then.session or not 0 <= elapsed_s <= config.max_carried_s:
            return None
        moved = se3.inverse(then.T_prior_camera) @ now.T_prior_camera
        return se3.orthonormalize(self.T_odom_camera @ moved)

    def pack(self) -> dict[str, Any]:
        """Arrays and plain values."""
        return asdict(self)

    @staticmethod
    def unpack(kept: dict[str, Any]) -> "DeadReckoningStart":
        return DeadReckoningStart(kept["T_odom_camera"], PriorPose(**kept["reading"]))
