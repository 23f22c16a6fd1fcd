"""Settings of the objects: association, creation, merge and removal (LDO-SLAM paper, III.C)."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """Settings of the data association between objects of the map and regions of a keyframe."""

    # Minimum IoU of the predicted box of an object and the box of a region (LDO-SLAM paper, III.C).
    min_iou: float = 0.4
    # Minimum common mass of the label distributions of an object and a region, 0..1: the sum of the
    # smaller probabilities. It prevents, for example, a match of a cup with the table whose box
    # contains the cup.
    min_shared: float = 0.3
    # Maximum gap between the depth ranges of an object and a region, and tolerance of the occlusion
    # test (LDO-SLAM paper, III.A: delta_z).
    max_depth_gap_m: float = 0.1
    min_gaussians: int = 8  # Minimum Gaussians of a region; fewer do not determine its position.
    # Maximum regions per keyframe; those with the most Gaussians are used. Images of COCO have 7
    # objects on average.
    max_regions: int = 64
    # Detectors draw separate boxes around a plant, its crown and its pot. A box counts as a part of
    # a larger box of the same class and depth if at least this fraction of its area lies inside the
    # larger box. Above 1, no box counts as a part.
    part_inside: float = 0.9

    def __post_init__(self) -> None:
        if not (0 < self.min_iou <= 1 and 0 <= self.min_shared <= 1):
            raise ConfigError(
                named(self, "min_iou", "min_shared")
                + ": min_iou must be in (0, 1], and min_shared must be in [0, 1]."
            )
        if self.max_depth_gap_m <= 0 or min(self.min_gaussians, self.max_regions) < 1:
            raise ConfigError(
                named(self, "max_depth_gap_m", "min_gaussians", "max_regions")
                + ": max_depth_gap_m must be positive; min_gaussians and max_regions must be at "
                "least 1."
            )
        if self.part_inside <= 0:
            raise ConfigError(
                f"AssociationConfig.part_inside={self.part_inside:g} must be positive."
            )


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Settings of the objects of the map: when they are created, merged and removed."""

    association: AssociationConfig = field(default_factory=AssociationConfig)
    # Keyframes that must observe a candidate before it becomes an object (LDO-SLAM paper, III.C).
    min_keyframes: int = 3
    # Maximum divergence (nats) between the label distributions of a candidate and of its
    # observation. At a larger one, the candidate's count of observations restarts (LDO-SLAM
    # paper, III.C).
    max_divergence: float = 0.2
    # Misses in a row after which an object is removed (LDO-SLAM paper, III.C).
    miss_limit: int = 10
    # Misses in a row after which an object is removed if the entropy of its label
    # distribution is above `uncertain_entropy`.
    uncertain_miss_limit: int = 5
    # Entropy (nats) of the label distribution above which an object is removed earlier
    # (LDO-SLAM paper, III.C).
    uncertain_entropy: float = 0.5
    # Misses in a row after which a candidate is removed; it can be created again.
    candidate_miss_limit: int = 3
    # A miss counts only if at least this fraction of an object's sampled Gaussians is in view
    # and not occluded.
    min_visible: float = 0.5
    # A miss counts only if the square root of the predicted box's area is at least this length,
    # because a detector may overlook smaller objects.
    min_side_px: float = 20.0
    # Two objects merge if at least this fraction of one object's sampled Gaussians lies in the
    # other object's box.
    merge_overlap: float = 0.5
    # Maximum number of objects. 2000 objects take 6 MB of memory. If all of them are in view, they
    # take a few milliseconds per keyframe.
    max_objects: int = 2000
    max_candidates: int = 256  # Maximum candidates; the most recently observed ones are kept.

    def __post_init__(self) -> None:
        counts = (
            *("min_keyframes", "miss_limit", "uncertain_miss_limit"),
            *("candidate_miss_limit", "max_objects", "max_candidates"),
        )
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(named(self, *counts) + ": each of these values must be at least 1.")
        if min(self.max_divergence, self.uncertain_entropy) < 0:
            raise ConfigError(
                named(self, "max_divergence", "uncertain_entropy")
                + ": each of these values must be at least 0."
            )
        if not (0 < self.min_visible <= 1 and 0 < self.merge_overlap <= 1):
            raise ConfigError(
                named(self, "min_visible", "merge_overlap")
                + ": min_visible and merge_overlap must be in (0, 1]."
            )
