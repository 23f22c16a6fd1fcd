"""Settings that are constants of the LDO-SLAM paper, or switch to its rules."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from ldo_service.errors import ConfigError

from .values import (
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """Constants of the LDO-SLAM paper, and switches from the default rules to those of the paper.

    These settings serve to reproduce the results of the paper. Users need not tune them.
    """

    # Rule that labels a Gaussian: the fraction of its splat that a region covers, or the
    # LDO-SLAM paper's IoU of box and Gaussian (III.A). IoU labels almost no Gaussian, because a
    # splat has few pixels.
    assignment_rule: Literal["coverage", "iou"] = advanced("coverage")
    # Pixels that a detection labels: the foreground in its box, or the whole box as in the LDO-SLAM
    # paper, III.A.
    label_region: Literal["foreground", "box"] = advanced("foreground")
    # Maximum distance of a labelled Gaussian from the measured depth, meters. This is delta_z
    # (LDO-SLAM paper, III.A).
    max_depth_gap_m: PositiveFloat = advanced(0.1)
    # Depth test of a labelled Gaussian: at the measured depth (two_sided), or not behind it
    # (one_sided, as in the LDO-SLAM paper, III.A).
    depth_test: Literal["two_sided", "one_sided"] = advanced("two_sided")
    # Rule of the moving average of labels: that of this implementation (corrected), or that of the
    # LDO-SLAM paper, III.A (paper).
    ema_rule: Literal["corrected", "paper"] = advanced("corrected")
    # Fraction of its past that the moving average keeps. This is lambda (LDO-SLAM paper, III.A).
    ema_keep_ratio: Annotated[float, Meta(ge=0, lt=1)] = advanced(0.9)
    # Fraction by which both rules weaken uncertain observations of settled Gaussians. 0 reproduces
    # the LDO-SLAM paper (III.A), where nothing weakens them.
    ema_hold_back_ratio: Ratio = advanced(1.0)
    # Number of successive keyframes without an observation after which `ema_rule: paper` removes a
    # label. This is N_miss (LDO-SLAM paper, III.A).
    label_max_misses: Annotated[int, Meta(ge=1, le=255)] = advanced(5)
    # Rule that fuses detector and labeller: by their reliabilities (adaptive), by a fixed weight
    # (fixed), or not at all (detector). The LDO-SLAM paper has the first one (III.B).
    fusion_rule: Literal["adaptive", "fixed", "detector"] = advanced("adaptive")
    # Constant beta of the adaptive fusion (LDO-SLAM paper, III.B).
    fusion_beta: PositiveFloat = advanced(2.0)
    # Constant epsilon of the adaptive fusion (LDO-SLAM paper, III.B).
    fusion_epsilon: PositiveFloat = advanced(1e-6)
    # Weight of the detector in the fixed fusion, an ablation (LDO-SLAM paper, IV.C).
    fusion_fixed_weight: Ratio = advanced(0.5)
    # Distance scale of the weights with which neighbors average their labels, meters. This is
    # sigma_cons (LDO-SLAM paper, III.A).
    consistency_sigma_m: PositiveFloat = advanced(0.05)
    # Maximum distance of neighbors, meters. The default is three times the distance scale, where a
    # weight is below 2e-4.
    consistency_radius_m: PositiveFloat = advanced(0.15)
    # Fraction by which one step moves a label toward the average of its neighbors. This is 1 -
    # lambda (LDO-SLAM paper, III.A).
    consistency_rate: Ratio = advanced(0.1)
    # Maximum KL divergence of the classes of a detection and an object to associate the two
    # (LDO-SLAM paper, III.C).
    object_max_divergence_nats: NonNegativeFloat = advanced(0.2)
    # Maximum KL divergence of the classes of matching landmarks of two subgraphs
    # (LDO-SLAM paper, III.C).
    loop_max_divergence_nats: PositiveFloat = advanced(0.3)
    # Minimum number of keyframes in a subgraph (LDO-SLAM paper, III.C).
    subgraph_min_keyframes: PositiveInt = advanced(3)
    # Maximum number of keyframes in a subgraph (LDO-SLAM paper, III.C).
    subgraph_max_keyframes: Annotated[int, Meta(ge=2)] = advanced(5)
    # Information of an observation of a landmark, relative to that of an independent one. The
    # LDO-SLAM paper (III.C) treats all observations as independent, which is 1.
    observation_information_ratio: Annotated[float, Meta(gt=0, le=1)] = advanced(1 / 320)
    # Weight of the observed classes of a landmark (LDO-SLAM paper, III.C).
    lambda_sem: PositiveFloat = advanced(0.5)
    # Weight of the agreement between landmarks of one class (LDO-SLAM paper, III.C).
    w_sem: NonNegativeFloat = advanced(0.1)
    # One keyframe per interval of this length stays a variable of the pose graph. The others are
    # marginalized (LDO-SLAM paper, III.C).
    marginalization_interval_keyframes: PositiveInt = advanced(10)

    def __post_init__(self) -> None:
        if self.subgraph_min_keyframes > self.subgraph_max_keyframes:
            raise ConfigError(
                f"paper.subgraph_min_keyframes={self.subgraph_min_keyframes} must be at most "
                f"paper.subgraph_max_keyframes={self.subgraph_max_keyframes}."
            )
