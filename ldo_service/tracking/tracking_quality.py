"""Tracking status from the quality of an alignment.

The fraction of inliers cannot detect a wrong local minimum of the alignment. At such a minimum, the
estimated residual noise is so large that every residual counts as an inlier. The status therefore
depends on other measures: overlap with the reference keyframe, residual noise relative to its
running median, condition number of the information matrix, and confirmation by ORB features or
GICP.

The residual noise of a correct pose grows too: with blur, a change of exposure, a steep viewing
angle or a large motion. Features have errors of another kind. A pose that is close to the pose by
features is therefore accepted with more noise.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from statistics import median

import numpy as np

from ldo_service.errors import ConfigError

from .alignment import Alignment
from .motion import image_motion_rad
from .pose_candidates import PoseHypothesis

MIN_GAIN = 0.05  # Lower bound of the gain that noise is divided by; a darker frame shows nothing.


class TrackingStatus(StrEnum):
    """Tracking status of a frame: OK, WEAK or LOST."""

    OK = "OK"
    WEAK = "WEAK"  # The pose is known, but not reliable enough for mapping.
    LOST = "LOST"  # The pose is unknown.


@dataclass(frozen=True, slots=True)
class TrackingQualityConfig:
    """Limits that decide whether the tracking status is OK, WEAK or LOST."""

    # Minimum visible fraction of the reference points of an OK frame; chosen on the sequence
    # apartment_floor1 alone.
    min_overlap: float = 0.15
    # Minimum fraction of the reference points paired with a measured depth; with fewer pairs, the
    # pose would depend on gray levels alone.
    min_paired: float = 0.05
    # Maximum condition number of the information, with translation in median depths.
    max_condition: float = 1e5
    # Maximum gain, and inverse of the minimum gain. A camera that moves into light changes its
    # exposure by about this factor, 1.5 stops.
    max_gain: float = 3.0
    # The residual limits below are ratios of the noise of an alignment to its running median.
    weak_residual: float = 2.5  # Maximum ratio of an OK frame.
    lost_residual: float = 5.0  # A frame with a larger ratio is LOST.
    lost_overlap: float = 0.08  # A frame with a smaller overlap is LOST.
    # Residual limits of a pose within confirmed_rad of the pose by features. They replace
    # weak_residual and lost_residual if those are smaller, except while tracking is LOST. They were
    # chosen on parts of ScanNet and on freiburg1_rpy. There, frames above weak_residual had an
    # error of at most 0.01 rad if they were within 0.03 rad of the feature pose, and of up to 0.07
    # rad otherwise.
    confirmed_rad: float = 0.03
    confirmed_weak_residual: float = 6.0
    confirmed_lost_residual: float = 15.0
    # Lower bounds of the running medians: noise that any camera has. Intensity in gray levels.
    min_intensity_sigma: float = 2.0
    min_depth_noise_scale: float = 0.5
    # Minimum overlap of the first OK frame after a loss, unless an independent estimate confirms
    # the pose. On the sequences kitchen and `synthetic:flat`, all 43 confirmed poses with less
    # overlap were right.
    relocalized_overlap: float = 0.35
    # Residual limit of the first OK frame after a loss, at the pose of the keyframe. The limit
    # grows by relocalized_residual_per_rad per radian of image motion from the keyframe
    # (`motion.image_motion_rad`), up to weak_residual. The noise of right poses grows with it
    # too: on the sequence kitchen, its median is 1.4 at 0.15 rad and 2.0 at 0.55 rad. A fixed
    # limit of 1.6 relocalized a third fewer frames of kitchen. It accepted one more false pose in
    # the ambiguous corridor of `synthetic:flat`.
    relocalized_residual: float = 1.3
    relocalized_residual_per_rad: float = 2.0
    # Expected noise while the history is empty. Intensity in gray levels.
    first_intensity_sigma: float = 8.0
    first_depth_noise_scale: float = 2.0
    recovery_margin: float = 0.8  # Limits are stricter by this factor until a frame is OK again.
    history: int = 30  # Number of OK frames in the running median: one second at 30 Hz.

    def __post_init__(self) -> None:
        if not 0 <= self.lost_overlap <= self.min_overlap <= 1:
            raise ConfigError(
                f"TrackingQualityConfig.lost_overlap={self.lost_overlap:g} and "
                f"min_overlap={self.min_overlap:g} must satisfy "
                "0 <= lost_overlap <= min_overlap <= 1."
            )
        if not 1 < self.weak_residual <= self.lost_residual:
            raise ConfigError(
                f"TrackingQualityConfig.weak_residual={self.weak_residual:g} must be above 1 and "
                f"at most lost_residual={self.lost_residual:g}."
            )
        if not self.confirmed_weak_residual <= self.confirmed_lost_residual:
            raise ConfigError(
                f"TrackingQualityConfig.confirmed_weak_residual={self.confirmed_weak_residual:g} "
                f"must be at most confirmed_lost_residual={self.confirmed_lost_residual:g}."
            )
        if self.relocalized_residual < 1 or self.relocalized_residual_per_rad < 0:
            raise ConfigError(
                f"TrackingQualityConfig.relocalized_residual={self.relocalized_residual:g} must be "
                "at least 1, and "
                f"relocalized_residual_per_rad={self.relocalized_residual_per_rad:g} must be at "
                "least 0."
            )
        if not 0 < self.recovery_margin <= 1 or self.history < 1:
            raise ConfigError(
                f"TrackingQualityConfig.recovery_margin={self.recovery_margin:g} must be above 0 "
                f"and at most 1, and history={self.history} must be at least 1."
            )


@dataclass(frozen=True, slots=True)
class ResidualHistory:
    """Photometric and geometric residual noise of the last OK frames, oldest first."""

    # Photometric noise, in gray levels as the image of the reference keyframe has them.
    intensity_sigmas: tuple[float, ...] = ()
    depth_noise_scales: tuple[float, ...] = ()  # Geometric noise, multiples of `DepthNoise`.

    def extended(self, alignment: Alignment, config: TrackingQualityConfig) -> "ResidualHistory":
        """Return the history with the residual noise of one more alignment.

        The added noise is limited to `weak_residual` times the running median. Otherwise a few
        frames with much noise, whose poses features confirm, would raise the median, and a wrong
        pose in a later frame would not stand out.
        """
        keep, sigma = config.history - 1, exposure_corrected_sigma(alignment)
        usual_sigma, usual_scale = self._usual(config)
        most = config.weak_residual
        scale = min(alignment.depth_noise_scale, most * usual_scale)
        return ResidualHistory(
            (*self.intensity_sigmas[-keep:], min(sigma, most * usual_sigma)),
            (*self.depth_noise_scales[-keep:], scale),
        )

    def _usual(self, config: TrackingQualityConfig) -> tuple[float, float]:
        """Return the running medians of photometric (gray levels) and geometric noise."""
        usual_sigma = median(self.intensity_sigmas or (config.first_intensity_sigma,))
        usual_scale = median(self.depth_noise_scales or (config.first_depth_noise_scale,))
        return (
            max(usual_sigma, config.min_intensity_sigma),
            max(usual_scale, config.min_depth_noise_scale),
        )

    def residual_ratio(self, alignment: Alignment, config: TrackingQualityConfig) -> float:
        """Return the residual noise of an alignment, divided by the running median.

        The result is the larger of two ratios, one for photometric and one for geometric noise.
        """
        intensity, depth = self._usual(config)
        return max(
            exposure_corrected_sigma(alignment) / intensity, alignment.depth_noise_scale / depth
        )


def exposure_corrected_sigma(alignment: Alignment) -> float:
    """Return the photometric noise of an alignment, in gray levels of the reference keyframe.

    Noise in gray levels of the frame grows with the exposure of the frame. The function therefore
    divides this noise by the gain of the alignment.
    """
    return alignment.intensity_sigma / max(alignment.gain, MIN_GAIN)


def classify_tracking(
    candidate: PoseHypothesis,
    history: ResidualHistory,
    previous: TrackingStatus,
    config: TrackingQualityConfig,
) -> TrackingStatus:
    """Return the tracking status of a frame from the quality of its best alignment.

    The limits have hysteresis. They are stricter after a WEAK frame, unless an independent estimate
    (features or GICP) confirms the pose. They are strictest after a LOST frame, unless such an
    estimate and the odometry prior both confirm the pose. The status changes from LOST to OK
    directly, never to WEAK. A pose within `config.confirmed_rad` of the pose by features may have
    more residual noise, except after a LOST frame.

    Args:
        candidate: Best pose hypothesis of the frame.
        history: Residual noise of the last OK frames.
        previous: Status of the previous frame.
        config: Limits.
    """
    alignment = candidate.alignment
    is_known = previous is TrackingStatus.WEAK or candidate.agrees_with_prior
    vouched = candidate.is_confirmed and is_known
    limits = config if vouched else _limits(previous, candidate, config)
    is_close = candidate.feature_distance_rad <= config.confirmed_rad
    if is_close and previous is not TrackingStatus.LOST:
        limits = replace(
            limits,
            weak_residual=max(config.weak_residual, config.confirmed_weak_residual),
            lost_residual=max(config.lost_residual, config.confirmed_lost_residual),
        )
    ratio = history.residual_ratio(alignment, config)
    if ratio > limits.lost_residual or alignment.overlap < config.lost_overlap:
        return TrackingStatus.LOST
    plausible = (
        alignment.overlap >= limits.min_overlap
        and alignment.paired >= limits.min_paired
        and alignment.condition <= limits.max_condition
        and abs(np.log(max(alignment.gain, 1e-6))) <= np.log(limits.max_gain)
        and ratio <= limits.weak_residual
        and candidate.is_confirmed is not False
    )
    if plausible:
        return TrackingStatus.OK
    return TrackingStatus.LOST if previous is TrackingStatus.LOST else TrackingStatus.WEAK


def _limits(
    previous: TrackingStatus, candidate: PoseHypothesis, config: TrackingQualityConfig
) -> TrackingQualityConfig:
    if previous is TrackingStatus.OK:
        return config
    if previous is TrackingStatus.LOST:
        moved_rad = image_motion_rad(
            candidate.alignment.T_reference_camera, candidate.median_depth_m
        )
        residual = config.relocalized_residual + config.relocalized_residual_per_rad * moved_rad
        overlap = config.min_overlap / config.recovery_margin
        if not candidate.is_confirmed:
            overlap = max(overlap, config.relocalized_overlap)
        return replace(
            config,
            min_overlap=overlap,
            weak_residual=min(config.weak_residual, residual),
        )
    return replace(
        config,
        min_overlap=config.min_overlap / config.recovery_margin,
        min_paired=config.min_paired / config.recovery_margin,
        max_condition=config.max_condition * config.recovery_margin,
        weak_residual=max(config.weak_residual * config.recovery_margin, 1.0),
    )
