"""Settings of the objects: association, and when they appear, merge and are removed (III.C)."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """Settings of the data association."""

    min_iou: float = 0.4  # Minimum IoU of the boxes (III.C).
    # Minimum `common_mass`: a cup lies in the box of its table, but is no table.
    min_shared: float = 0.3
    # Maximum gap between depth ranges; tolerance of the occlusion test (delta_z, III.A).
    max_depth_gap_m: float = 0.1
    min_gaussians: int = 8  # Minimum Gaussians of a region; with fewer, its position is unknown.
    # Maximum regions per keyframe, those with the most Gaussians; COCO images have 7.
    max_regions: int = 64
    # Detectors draw separate boxes around a plant, its crown and its pot. A box is a part of a
    # larger one of its class and depth if this fraction of it lies inside; above 1, none is.
    part_inside: float = 0.9

    def __post_init__(self) -> None:
        if not (0 < self.min_iou <= 1 and 0 <= self.min_shared <= 1):
            raise ConfigError(
                named(self, "min_iou", "min_shared")
                + ": min_iou must be in (0, 1], min_shared in [0, 1]."
            )
        if self.max_depth_gap_m <= 0 or min(self.min_gaussians, self.max_regions) < 1:
            raise ConfigError(
                named(self, "max_depth_gap_m", "min_gaussians", "max_regions")
                + ": max_depth_gap_m must be positive, the counts at least 1."
            )
        if self.part_inside <= 0:
            raise ConfigError(f"part_inside={self.part_inside:g} must be positive.")


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Settings of the objects."""

    association: AssociationConfig = field(default_factory=AssociationConfig)
    # Keyframes that must observe a candidate before it becomes an object (III.C).
    min_keyframes: int = 3
    # Maximum divergence (nats) of an observation from the candidate (III.C).
    max_divergence: float = 0.2
    miss_limit: int = 10  # Misses in a row, while it is visible, that remove an object (III.C).
    uncertain_miss_limit: int = 5  # The same for objects with a high entropy.
    # Minimum entropy (nats) of such objects, which are removed earlier (III.C).
    uncertain_entropy: float = 0.5
    # The same for candidates; a removed candidate can be created again.
    candidate_miss_limit: int = 3
    min_visible: float = 0.5  # Minimum fraction of the members in view and not occluded for a miss.
    # Minimum side of the predicted box for a miss; smaller objects may be overlooked.
    min_side_px: float = 20.0
    merge_overlap: float = 0.5  # Minimum fraction of the members of one in the box of the other.
    max_objects: int = 2000  # 6 MB, and some ms per keyframe if all are in view.
    max_candidates: int = 256  # Maximum candidates; those observed last are kept.

    def __post_init__(self) -> None:
        counts = (
            *("min_keyframes", "miss_limit", "uncertain_miss_limit"),
            *("candidate_miss_limit", "max_objects", "max_candidates"),
        )
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(named(self, *counts) + ": each must be at least 1.")
        if min(self.max_divergence, self.uncertain_entropy) < 0:
            raise ConfigError(
                named(self, "max_divergence", "uncertain_entropy") + ": each must be at least 0."
            )
        if not (0 < self.min_visible <= 1 and 0 < self.merge_overlap <= 1):
            raise ConfigError(
                named(self, "min_visible", "merge_overlap")
                + ": min_visible and merge_overlap must be in (0, 1]."
            )
