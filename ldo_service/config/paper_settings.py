"""Constants of the paper, and switches to its literal rules."""

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
    """Constants of the paper, and switches to its literal rules where the defaults differ.

    They are counted apart from the other settings: they reproduce the paper and tune nothing.
    """

    # Gaussians are labeled by how much of a splat a region covers, or by the paper's IoU of box and
    # Gaussian (III.A). By IoU almost none is labeled, because a splat has few pixels.
    assignment_rule: Literal["coverage", "iou"] = advanced("coverage")
    # A detection labels the foreground within its box, or the whole box as in the paper (III.A).
    label_region: Literal["foreground", "box"] = advanced("foreground")
    # This is delta_z: a Gaussian farther from the measured depth is not labeled (III.A).
    max_depth_gap_m: PositiveFloat = advanced(0.1)
    # Labels are averaged by the corrected rule, or by the paper's (III.A).
    ema_rule: Literal["corrected", "paper"] = advanced("corrected")
    # This is lambda: the average keeps so much of its past (III.A).
    ema_keep_ratio: Annotated[float, Meta(ge=0, lt=1)] = advanced(0.9)
    # The corrected rule weakens uncertain observations of settled Gaussians by this fraction.
    ema_hold_back_ratio: Ratio = advanced(1.0)
    # This is N_miss: the paper's rule removes a label after so many keyframes (III.A).
    label_max_misses: Annotated[int, Meta(ge=1, le=255)] = advanced(5)
    # Detector and labeller are fused by entropy (adaptive), by a fixed weight, or not (detector).
    fusion_rule: Literal["adaptive", "fixed", "detector"] = advanced("adaptive")
    # This is beta of the adaptive fusion (III.B).
    fusion_beta: PositiveFloat = advanced(2.0)
    # This is epsilon of the adaptive fusion (III.B).
    fusion_epsilon: PositiveFloat = advanced(1e-6)
    # This is the weight of the fixed fusion, an ablation (IV.C).
    fusion_fixed_weight: Ratio = advanced(0.5)
    # This is sigma_cons: neighbors closer than this share their labels (III.A).
    consistency_sigma_m: PositiveFloat = advanced(0.05)
    # Neighbors beyond this are ignored: three sigma, where a weight is below 2e-4.
    consistency_radius_m: PositiveFloat = advanced(0.15)
    # This is 1 - lambda: one step moves a label by this fraction (III.A).
    consistency_rate: Ratio = advanced(0.1)
    # A detection belongs to an object up to this KL divergence of their classes (III.C).
    object_max_divergence_nats: NonNegativeFloat = advanced(0.2)
    # Landmarks of two subgraphs match up to this KL divergence of their classes (III.C).
    loop_max_divergence_nats: PositiveFloat = advanced(0.3)
    # A subgraph has so many keyframes at least (III.C).
    subgraph_min_keyframes: PositiveInt = advanced(3)
    # A subgraph has so many keyframes at most (III.C).
    subgraph_max_keyframes: Annotated[int, Meta(ge=2)] = advanced(5)
    # This is the weight of what was observed of a landmark's class (III.C).
    lambda_sem: PositiveFloat = advanced(0.5)
    # This is the weight of the agreement between landmarks of one class (III.C).
    w_sem: NonNegativeFloat = advanced(0.1)
    # One of so many keyframes stays a variable of the graph. The others are marginalized (III.C).
    marginalization_interval_keyframes: PositiveInt = advanced(10)

    def __post_init__(self) -> None:
        if self.subgraph_min_keyframes > self.subgraph_max_keyframes:
            raise ConfigError(
                f"paper.subgraph_min_keyframes={self.subgraph_min_keyframes} must be at most "
                f"paper.subgraph_max_keyframes={self.subgraph_max_keyframes}."
            )
