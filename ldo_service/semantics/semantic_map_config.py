"""Settings of the labels and objects of a map."""

from dataclasses import dataclass, field

from ldo_service.detection.dynamic_classes import DynamicClassConfig
from ldo_service.errors import ConfigError, named
from ldo_service.regions.open_vocabulary import OpenVocabularyConfig

from .gaussian_labels import MAX_LABELS
from .objects_config import ObjectsConfig
from .semantic_fusion import SemanticFusionConfig


@dataclass(frozen=True, slots=True)
class SemanticMapConfig:
    """Settings of the labels and objects of a map."""

    labelling: SemanticFusionConfig = field(default_factory=SemanticFusionConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    # Label requests to the labeller, and the use of its results.
    naming: OpenVocabularyConfig = field(default_factory=OpenVocabularyConfig)
    # Classes that move by themselves, such as people.
    movable: DynamicClassConfig = field(default_factory=DynamicClassConfig)
    # Minimum score of a detection of a dynamic class, such as a person, that removes the
    # surface from the map. Detections with this score need no label request either. The score is
    # high: a false detection of a person in a picture would cut a hole into the map. A hole is
    # worse than a person left in the map.
    movable_confidence: float = 0.6
    max_names: int = MAX_LABELS  # Maximum names in the vocabulary; further names become `other`.
    # Maximum number of keyframes whose detections are stored until the keyframe is mapped. It
    # equals the number of keyframes that may be in transit to the mapper.
    max_waiting: int = 8
    # Number of the newest keyframes whose ids are remembered, to drop repeated detections. After a
    # restart, the messages of 8 keyframes are sent again.
    max_remembered: int = 64

    def __post_init__(self) -> None:
        if self.max_waiting < 0 or self.max_remembered < 1 or self.max_names > MAX_LABELS:
            raise ConfigError(
                named(self, "max_names", "max_waiting", "max_remembered")
                + ": max_waiting must be at least 0, max_remembered must be at least 1, and "
                + f"max_names must be at most {MAX_LABELS}."
            )

    @property
    def uses_labeller(self) -> bool:
        """True if labels of the labeller are fused into the map."""
        return self.labelling.fusion.rule != "detector"
