"""Whether an alignment is right: independent signs, compared with the recent past.

Inlier fractions do not see a wrong local minimum, whose inflated noise estimate makes everything
an inlier. So an alignment is judged by what it cannot fake: how much of the surface it shows
again, its noise against the running median, the condition of its information, and whether
features found the same pose.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from statistics import median

import numpy as np

from ldo_service.errors import ConfigError

from .alignment import Alignment
from .motion import image_motion_rad
from .pose_candidates import PoseHypothesis

MIN_GAIN = 0.05  # a frame this dark shows nothing


class TrackingStatus(StrEnum):
    OK = "OK"
    WEAK = "WEAK"  # a pose, but nothing to build a map on
    LOST = "LOST"  # no pose


@dataclass(frozen=True, slots=True)
class TrackingQualityConfig:
    min_overlap: float = 0.15  # visible reference points; chosen on apartment_floor1, not elsewhere
    min_paired: float = 0.05  # of the reference points met by a depth: below, colour is alone
    max_condition: float = 1e5  # of the information in median depths
    max_gain: float = 3.0  # either way: a stop and a half, as cameras that step into the light do
    weak_residual: float = 2.5  # times the running median
    lost_residual: float = 5.0  # times the running median: never accepted
    lost_overlap: float = 0.08
    least_intensity_sigma: float = 2.0  # grey levels: what any camera has, for the comparison
    least_depth_noise_scale: float = 0.5
    # A camera that is found without a prediction must show more, unless features found the same
    # pose (43 of 43 such finds below 0.35 were right, kitchen and flat), and fit better: within
    # this many times the running median seen from the same pose, plus so much per radian of motion
    # and parallax from it (`motion.extent`), as the noise of true finds grows (kitchen, p50 1.4 at
    # 0.15 rad, 2.0 at 0.55), and within weak_residual. 1.6 at any distance found a third fewer of
    # the kitchen's frames, and one more false one in the flat's twin corridor.
    relocalised_overlap: float = 0.35
    relocalised_residual: float = 1.3
    relocalised_residual_per_rad: float = 2.0
    first_intensity_sigma: float = 8.0  # grey levels; expected while there is no past
    first_depth_noise_scale: float = 2.0
    recovery_margin: float = 0.8  # limits are this much stricter until a frame is OK again
    history: int = 30  # frames of the running median: a second

    def __post_init__(self) -> None:
        if not 0 <= self.lost_overlap <= self.min_overlap <= 1:
            raise ConfigError("overlaps must be ordered 0 <= lost_overlap <= min_overlap <= 1.")
        if not 1 < self.weak_residual <= self.lost_residual:
            raise ConfigError("residual limits must be ordered 1 < weak <= lost.")
        if self.relocalised_residual < 1 or self.relocalised_residual_per_rad < 0:
            raise ConfigError(
                "relocalised_residual must be at least 1, relocalised_residual_per_rad at least 0."
            )
        if not 0 < self.recovery_margin <= 1 or self.history < 1:
            raise ConfigError("recovery_margin must be within 0..1 and history at least 1.")


@dataclass(frozen=True, slots=True)
class ResidualHistory:
    """Noise of the last trusted frames."""

    intensity_sigmas: tuple[float, ...] = ()
    depth_noise_scales: tuple[float, ...] = ()

    def extended(self, alignment: Alignment, config: TrackingQualityConfig) -> "ResidualHistory":
        keep = config.history - 1
        return ResidualHistory(
            (*self.intensity_sigmas[-keep:], exposure_corrected_sigma(alignment)),
            (*self.depth_noise_scales[-keep:], alignment.depth_noise_scale),
        )

    def residual_ratio(self, alignment: Alignment, config: TrackingQualityConfig) -> float:
        """The alignment's noise over its running median, the larger of colour and depth."""
        usual_sigma = median(self.intensity_sigmas or (config.first_intensity_sigma,))
        usual_scale = median(self.depth_noise_scales or (config.first_depth_noise_scale,))
        intensity = max(usual_sigma, config.least_intensity_sigma)
        depth = max(usual_scale, config.least_depth_noise_scale)
        return max(
            exposure_corrected_sigma(alignment) / intensity, alignment.depth_noise_scale / depth
        )


def exposure_corrected_sigma(alignment: Alignment) -> float:
    """Photometric noise in grey levels of the reference: it grows with the exposure."""
    return alignment.intensity_sigma / max(alignment.gain, MIN_GAIN)


def classify_tracking(
    candidate: PoseHypothesis,
    history: ResidualHistory,
    previous: TrackingStatus,
    config: TrackingQualityConfig,
) -> TrackingStatus:
    """The status of a frame by its best alignment, after a frame of `previous` status.

    Hysteresis: limits are stricter after a WEAK frame, unless features vouch for this one, and
    strictest after a loss, from which only OK leads back: there a prior must expect it too.
    """
    alignment = candidate.alignment
    is_known = previous is TrackingStatus.WEAK or candidate.agrees_with_prior
    vouched = candidate.is_confirmed and is_known
    limits = config if vouched else _limits(previous, candidate, config)
    ratio = history.residual_ratio(alignment, config)
    if ratio > config.lost_residual or alignment.overlap < config.lost_overlap:
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
        residual = config.relocalised_residual + config.relocalised_residual_per_rad * moved_rad
        overlap = config.min_overlap / config.recovery_margin
        if not candidate.is_confirmed:
            overlap = max(overlap, config.relocalised_overlap)
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
