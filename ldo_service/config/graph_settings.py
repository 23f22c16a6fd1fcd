"""Settings of the loop closer and the optimizer."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from .values import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class RetrievalSettings:
    """Search for places that look like the present one."""

    # Places are compared by names and images (two_stage), by names alone (semantic), or by images
    # alone (geometric). The latter two are for comparison.
    mode: Literal["two_stage", "semantic", "geometric"] = "two_stage"
    # Places fewer camera frames apart are no loop (III.C).
    min_gap_frames: NonNegativeInt = 100
    # The loop closer keeps so many subgraphs of up to 5 keyframes. Beyond, the path is thinned.
    max_subgraphs: Annotated[int, Meta(ge=3)] = 1000
    # The closest so many subgraphs are verified. This is K (III.C).
    max_candidates: PositiveInt = advanced(5)
    # The names of two places must be so similar. This is theta_loop (III.C).
    min_similarity: Ratio = advanced(0.75)


@dataclass(frozen=True, slots=True)
class VerificationSettings:
    """Geometric check of a loop closure."""

    # So many features must agree on the pose. Fewer find more loops, and more false ones.
    min_inliers: Annotated[int, Meta(ge=6)] = 20
    # The old keyframe must see this fraction of the new surface too.
    min_overlap: Ratio = advanced(0.2)
    # The surfaces must fit with this error along their normals.
    max_rmse_m: PositiveFloat = advanced(0.03)


@dataclass(frozen=True, slots=True)
class DriftGateSettings:
    """Largest odometry drift that a closure may correct."""

    # A closure may correct so much drift on any path.
    max_drift_m: NonNegativeFloat = advanced(0.5)
    # A closure may correct this fraction of the path length too: ten times what depth cameras
    # drift.
    max_drift_ratio: NonNegativeFloat = advanced(0.1)


@dataclass(frozen=True, slots=True)
class LoopCloserSettings:
    """Recognition of places."""

    # False recognizes no place, to measure what loop closing contributes.
    enabled: bool = True
    retrieval: RetrievalSettings = field(default_factory=RetrievalSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    drift_gate: DriftGateSettings = field(default_factory=DriftGateSettings)


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """Noise of measurements in the graph."""

    # Rotations of odometry drift as a random walk of this rate. Without it no chain bends to a
    # loop.
    drift_rad_per_sqrt_m: NonNegativeFloat = advanced(0.02)
    # Translations of odometry drift as a random walk of this rate, about 1 % after some meters.
    drift_m_per_sqrt_m: NonNegativeFloat = advanced(0.02)
    # A loop closure has this rotation noise, because calibration and exposure are not modeled.
    loop_rotation_rad: PositiveFloat = advanced(0.01)
    # A loop closure has this translation noise.
    loop_translation_m: PositiveFloat = advanced(0.01)


@dataclass(frozen=True, slots=True)
class LoopClosureSettings:
    """Loop closures in the graph."""

    # A closure with a larger residual is rejected, as by RGBD/OptimizeMaxError of RTAB-Map.
    max_residual_sigmas: PositiveFloat = advanced(3.0)
    # The graph holds so many closures, 1 kB each. Beyond, the most redundant one is removed.
    max_closures: PositiveInt = advanced(500)


@dataclass(frozen=True, slots=True)
class LandmarkSettings:
    """Objects as landmarks of the graph."""

    # False leaves objects out of the graph, to measure what they contribute.
    enabled: bool = True
    # The graph holds so many landmarks. Beyond, those not seen for longest are removed.
    max_landmarks: PositiveInt = 1000
    # The graph takes observations in when enough of them wait (adaptive), or at every keyframe
    # (fixed).
    schedule: Literal["adaptive", "fixed"] = advanced("adaptive")


@dataclass(frozen=True, slots=True)
class OptimizerSettings:
    """Graph of keyframe poses and landmarks."""

    noise: NoiseSettings = field(default_factory=NoiseSettings)
    loop_closures: LoopClosureSettings = field(default_factory=LoopClosureSettings)
    landmarks: LandmarkSettings = field(default_factory=LandmarkSettings)
