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
    """Search for subgraphs of keyframes that look like the newest subgraph."""

    # Comparison of subgraphs: by labels, images and the objects of the map (two_stage), by labels
    # alone (semantic), or by images alone (geometric). The modes semantic and geometric serve for
    # evaluation.
    mode: Literal["two_stage", "semantic", "geometric"] = "two_stage"
    # The two keyframes of a loop closure are more than this number of camera frames apart (LDO-SLAM
    # paper, III.C).
    min_gap_frames: NonNegativeInt = 100
    # Maximum number of subgraphs, of up to 5 keyframes each, in the place database. Beyond this
    # number, subgraphs are removed evenly along the path.
    max_subgraphs: Annotated[int, Meta(ge=3)] = 1000
    # Maximum number of similar subgraphs that are verified, the most similar ones first. This is K
    # (LDO-SLAM paper, III.C). If all fail, the nearest other subgraph in the map is verified.
    max_candidates: PositiveInt = advanced(5)
    # Minimum similarity of the labels of two subgraphs. This is theta_loop (LDO-SLAM paper, III.C).
    min_similarity: Ratio = advanced(0.75)


@dataclass(frozen=True, slots=True)
class VerificationSettings:
    """Geometric verification of a loop closure."""

    # Minimum number of features that agree on the pose. A lower value finds more loop closures, and
    # more false ones.
    min_inliers: Annotated[int, Meta(ge=6)] = 20
    # Minimum fraction of the surface in the new keyframe that the old keyframe shows too.
    min_overlap: Ratio = advanced(0.2)
    # Maximum RMSE between the two surfaces along their normals, meters.
    max_rmse_m: PositiveFloat = advanced(0.03)


@dataclass(frozen=True, slots=True)
class DriftGateSettings:
    """Maximum odometry drift that a loop closure may correct."""

    # Drift that a loop closure may correct on a path of any length, meters.
    max_drift_m: NonNegativeFloat = advanced(0.5)
    # Additional drift that a loop closure may correct, as a fraction of the path length. The
    # default is ten times the usual drift of odometry with depth cameras.
    max_drift_ratio: NonNegativeFloat = advanced(0.1)


@dataclass(frozen=True, slots=True)
class LoopCloserSettings:
    """Detection of loop closures."""

    # True closes loops. False disables loop closing, to measure its contribution.
    enabled: bool = True
    retrieval: RetrievalSettings = field(default_factory=RetrievalSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    drift_gate: DriftGateSettings = field(default_factory=DriftGateSettings)


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """Noise of measurements in the pose graph."""

    # Random walk of odometry rotations, in radians per square root of a meter. With 0, the
    # correction of a loop closure cannot be spread over the path.
    drift_rad_per_sqrt_m: NonNegativeFloat = advanced(0.02)
    # Random walk of odometry translations, in meters per square root of a meter. The default is 4
    # cm, or 1 %, after 4 m.
    drift_m_per_sqrt_m: NonNegativeFloat = advanced(0.02)
    # Rotation noise of a loop closure, radians. It covers errors of calibration and exposure, which
    # the measurement does not model.
    loop_rotation_rad: PositiveFloat = advanced(0.01)
    # Translation noise of a loop closure, meters.
    loop_translation_m: PositiveFloat = advanced(0.01)


@dataclass(frozen=True, slots=True)
class LoopClosureSettings:
    """Loop closures in the pose graph."""

    # Maximum residual of an accepted loop closure, in standard deviations, as
    # RGBD/OptimizeMaxError of RTAB-Map.
    max_residual_sigmas: PositiveFloat = advanced(3.0)
    # Maximum number of loop closures in the pose graph, 1 kB each. Beyond this number, the most
    # redundant loop closure is removed.
    max_closures: PositiveInt = advanced(500)


@dataclass(frozen=True, slots=True)
class LandmarkSettings:
    """Objects as landmarks of the pose graph."""

    # True adds objects to the pose graph. False omits them, to measure their contribution.
    enabled: bool = True
    # Maximum number of landmarks in the pose graph. Beyond this number, the landmarks that were not
    # observed for the longest time are removed.
    max_landmarks: PositiveInt = 1000
    # Time at which object observations are added to the pose graph: when enough of them are pending
    # (adaptive), or at every keyframe (fixed).
    schedule: Literal["adaptive", "fixed"] = advanced("adaptive")


@dataclass(frozen=True, slots=True)
class OptimizerSettings:
    """Pose graph of keyframes and landmarks."""

    noise: NoiseSettings = field(default_factory=NoiseSettings)
    loop_closures: LoopClosureSettings = field(default_factory=LoopClosureSettings)
    landmarks: LandmarkSettings = field(default_factory=LandmarkSettings)
