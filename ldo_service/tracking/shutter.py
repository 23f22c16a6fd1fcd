"""Motion of the camera while it records a frame, and compensation of this motion.

The velocity comes from the poses of the last frames. Before a frame is tracked, the frame is
compensated with the expected velocity. If the tracked pose then shows another velocity, the frame
is compensated again.
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.calibration.shutter import FrameMotion, ShutterTiming, displacement_rad
from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera

from .motion import ConstantVelocity
from .shutter_timing import BandEquations, TimingEvidence

# Weight of evidence that is older than a large change of the timing or of the image correction.
EARLIER_WEIGHT = 0.25


@dataclass(frozen=True, slots=True)
class ShutterConfig:
    """Settings of the estimation and compensation of the shutter's timing."""

    is_on: bool = True  # False: neither estimation nor compensation.
    # Timing to start with, such as that of the map in which the camera is localized.
    initial: ShutterTiming = field(default_factory=ShutterTiming)
    # Maximum interval between two frames whose mean velocity is used. A hand shakes with periods of
    # 0.2 s.
    max_interval_s: float = 0.15
    # The times are compensated if one of them exceeds both min_s and this multiple of its standard
    # deviation. Within min_s, a turn of 60 degrees/s moves the image by less than 1.7 of 640
    # pixels.
    sigmas: float = 4.0
    min_s: float = 0.003
    max_s: float = 0.05  # Larger estimates are rejected, because a frame lasts 33 ms.
    # Maximum standard deviation of each time. All times are compensated together, so none may be
    # more uncertain.
    max_sigma_s: float = 0.015
    update_frames: int = 3  # Number of measurements between two estimates.
    # Change of a time after which earlier evidence counts less. The earlier equations are linear
    # approximations, which give too small times for large displacements.
    relinearized_s: float = 0.004
    max_frames: int = 300  # Measurements after which the estimate is final.
    # Minimum velocity of a measurement, as image motion within 10 ms, rad. Slower frames contain no
    # information about the times.
    min_motion_rad: float = 0.003
    # A frame is compensated and aligned again if its measured velocity differs from the expected
    # one by more than this. The unit is the displacement of the image as a fraction of its width.
    realign_ratio: float = 0.75 / 640
    # Larger limit of the same difference. Below it, the frame is not aligned again: only its
    # pose is corrected, to first order. Frames that become keyframes are always aligned again. The
    # trajectory error (ATE) on freiburg1_rpy_part is 1.7 cm with 3 pixels and 2.4 cm with 8 pixels.
    max_linear_ratio: float = 3.0 / 640

    def __post_init__(self) -> None:
        if min(self.update_frames, self.max_frames) < 1:
            raise ConfigError(
                named(self, "update_frames", "max_frames") + ": both values must be at least 1."
            )
        positive = "max_interval_s", "sigmas", "max_s", "max_sigma_s", "realign_ratio"
        if not min(getattr(self, name) for name in positive) > 0:
            raise ConfigError(named(self, *positive) + ": each of these values must be positive.")
        not_negative = "min_s", "relinearized_s", "min_motion_rad", "max_linear_ratio"
        if not min(getattr(self, name) for name in not_negative) >= 0:
            raise ConfigError(
                named(self, *not_negative) + ": each of these values must be at least 0."
            )


@dataclass(frozen=True, eq=False, slots=True)
class ShutterState:
    """State of the shutter compensation that is kept from frame to frame.

    Velocities are those of `FrameMotion`: rotation in rad/s, then translation in m/s.
    """

    timing: ShutterTiming = field(default_factory=ShutterTiming)  # Timing that is compensated.
    evidence: TimingEvidence = field(default_factory=TimingEvidence)  # Evidence for it.
    # Mean velocity between the last two frames that have a pose, [6]; None if unknown.
    mean_velocity: np.ndarray | None = None
    # Velocity at the reference keyframe, [6]: the mean of the velocities before and after it. None
    # if unknown, and at the frame after a new reference.
    reference_velocity: np.ndarray | None = None
    has_new_reference: bool = False  # True if the last frame became the reference.
    # Normal equations of the last frame, not yet in `evidence`. They wait for the next frame, which
    # shows the velocity at the last one.
    pending: BandEquations | None = None

    def informed(self, equations: np.ndarray | None, config: ShutterConfig) -> "ShutterState":
        """Return the state with the self-calibration's estimate as the prior of the shutter timing.

        The timing has three times: readout of color, readout of depth and delay of depth.

        Args:
            equations: Normal equations of the three times in seconds, [3, 4]; see
                `CameraKnowledge.timing`. None if unknown.
            config: Settings.
        """
        known = self.evidence.prior
        if not config.is_on or equations is None or np.array_equal(known, equations):
            return self
        return self._estimated(replace(self.evidence, prior=equations), config)

    def expected_motion(
        self, before: ConstantVelocity, stamp_ns: int, config: ShutterConfig
    ) -> FrameMotion | None:
        """Predict the motion during a frame that is not tracked yet; None if unknown."""
        if self.mean_velocity is None or _interval_s(before, stamp_ns, config) is None:
            return None
        return FrameMotion(self.mean_velocity, self.timing)

    def measured_motion(
        self,
        before: ConstantVelocity,
        T_odom_camera: np.ndarray,
        stamp_ns: int,
        config: ShutterConfig,
    ) -> FrameMotion | None:
        """Return the motion during a frame with a known pose; None if unknown.

        The motion is the mean velocity since the last frame. A velocity extrapolated to the time of
        this frame would contain more noise from the poses. This noise would make the estimated
        times of the shutter grow without bound.

        Args:
            before: Pose and time of the last frame that has a pose.
            T_odom_camera: Pose of the frame, [4, 4].
            stamp_ns: Time of the frame.
            config: Settings.
        """
        interval_s = _interval_s(before, stamp_ns, config)
        if interval_s is None:
            return None
        return FrameMotion.between(before.T_odom_camera, T_odom_camera, interval_s, self.timing)

    def moved(self, motion: FrameMotion, config: ShutterConfig) -> "ShutterState":
        """Return the state after a frame with a known motion.

        The motion also determines the velocity of the camera at the previous frame. With this
        velocity, the stored residuals of the previous frame (`pending`) contribute to the estimate
        of the shutter timing.
        """
        mean, earlier, state = motion.velocity, self.mean_velocity, self
        if earlier is not None:
            at_last_frame = 0.5 * (mean + earlier)
            if self.pending is not None:
                state = self._with_equations(self.pending.timing_equations(at_last_frame), config)
            if self.has_new_reference:
                state = replace(state, reference_velocity=at_last_frame)
        elif self.has_new_reference:  # The first frame, or the first one after an interruption.
            state = replace(state, reference_velocity=mean)
        return replace(state, mean_velocity=mean, has_new_reference=False, pending=None)

    def interrupted(self) -> "ShutterState":
        """Return the state after a frame whose motion is unknown."""
        return replace(self, mean_velocity=None, has_new_reference=False, pending=None)

    def with_new_reference(self) -> "ShutterState":
        """Return the state after the last frame has become the reference."""
        return replace(self, reference_velocity=None, has_new_reference=True)

    def recorrected(self) -> "ShutterState":
        """Return the state after the camera correction (vignetting, depth bias) was replaced.

        Earlier evidence for the times of the shutter then counts less.
        """
        return replace(self, evidence=self.evidence.scaled(EARLIER_WEIGHT), pending=None)

    def _with_equations(self, equations: np.ndarray, config: ShutterConfig) -> "ShutterState":
        evidence = self.evidence.extended(equations)
        if evidence.count % config.update_frames:
            return replace(self, evidence=evidence)
        return self._estimated(evidence, config)

    def _estimated(self, evidence: TimingEvidence, config: ShutterConfig) -> "ShutterState":
        timing = _updated(self.timing, evidence, config)
        if timing.differs(self.timing, config.relinearized_s):
            evidence = evidence.scaled(EARLIER_WEIGHT)
        return replace(self, evidence=evidence, timing=timing)

    def metrics(self) -> dict[str, float]:
        """Return the shutter times in use, and the last estimates with standard deviations (ms).

        The estimates and standard deviations are missing until there is enough evidence.
        """
        found = self.evidence.estimate()
        if found is None:
            return self.timing.metrics()
        estimated, sigmas = (ShutterTiming(*times.tolist()).metrics() for times in found)
        return {
            **self.timing.metrics(),
            **{name.replace("_ms", "_estimate_ms"): time_ms for name, time_ms in estimated.items()},
            **{name.replace("_ms", "_sigma_ms"): time_ms for name, time_ms in sigmas.items()},
        }

    def pack(self) -> dict[str, Any]:
        """Return the state as arrays and plain values."""
        return {
            "timing": self.timing.pack(),
            "evidence": self.evidence.pack(),
            "mean_velocity": self.mean_velocity,
            "reference_velocity": self.reference_velocity,
            "has_new_reference": self.has_new_reference,
            "pending": None if self.pending is None else self.pending.pack(),
        }

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "ShutterState":
        """Return the state from its packed form."""
        pending = kept["pending"]
        return ShutterState(
            ShutterTiming.of(kept["timing"]),
            TimingEvidence.unpack(kept["evidence"]),
            kept["mean_velocity"],
            kept["reference_velocity"],
            bool(kept["has_new_reference"]),
            None if pending is None else BandEquations.unpack(pending),
        )


def displacement_ratio(
    expected: FrameMotion | None, measured: FrameMotion, median_depth_m: float, camera: Camera
) -> float:
    """Return the largest displacement of pixels that the shutter's timing still causes in a frame.

    The frame was compensated with the expected motion. The difference between the measured motion
    and the expected one displaces pixels.

    Args:
        expected: Motion that the frame was compensated with; None without compensation.
        measured: Motion that follows from the tracked pose of the frame.
        median_depth_m: Median depth of the scene.
        camera: Camera of the frame.

    Returns:
        Displacement as a fraction of the image width.
    """
    velocity = measured.velocity - (0.0 if expected is None else expected.velocity)
    return displacement_rad(velocity, measured.timing, median_depth_m) * camera.fx / camera.width


def _updated(
    timing: ShutterTiming, evidence: TimingEvidence, config: ShutterConfig
) -> ShutterTiming:
    """Return the times that are compensated from now on.

    If one estimate is significant and none is uncertain, all times are replaced by their estimates.
    Otherwise, all times stay. If only color or only depth were compensated, the two would no
    longer fit each other.
    """
    found = evidence.estimate()
    if found is None:
        return timing
    times_s, sigmas_s = found
    is_significant = np.abs(times_s) > np.maximum(config.sigmas * sigmas_s, config.min_s)
    is_possible = (np.abs(times_s) < config.max_s) & (sigmas_s < config.max_sigma_s)
    if not (is_significant.any() and is_possible.all()):
        return timing
    return ShutterTiming(*times_s.tolist())


def _interval_s(before: ConstantVelocity, stamp_ns: int, config: ShutterConfig) -> float | None:
    """Return the time since the last pose; None if it is too long or not positive."""
    interval_s = 1e-9 * (stamp_ns - before.stamp_ns)
    return interval_s if 0 < interval_s <= config.max_interval_s else None
