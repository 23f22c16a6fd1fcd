"""Settings of the objects: when they appear, merge and are removed (paper, III.C)."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .data_association import AssociationConfig


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
