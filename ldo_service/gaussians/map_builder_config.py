"""Settings of the map builder: densification, optimization, pruning and offloading."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .densification import DensificationConfig
from .fitting import ViewSamplingConfig
from .keyframe_store import KeyframeStoreConfig
from .optimizer import GaussianOptimizerConfig
from .pruning import DeduplicationConfig, PruningConfig
from .visibility import OffloadConfig


@dataclass(frozen=True, slots=True)
class MapBuilderConfig:
    """Settings of the map builder and of all its steps."""

    insertion: DensificationConfig = field(default_factory=DensificationConfig)
    optimizer: GaussianOptimizerConfig = field(default_factory=GaussianOptimizerConfig)
    sampling: ViewSamplingConfig = field(default_factory=ViewSamplingConfig)
    pruning: PruningConfig = field(default_factory=PruningConfig)
    merging: DeduplicationConfig = field(default_factory=DeduplicationConfig)
    store: KeyframeStoreConfig = field(default_factory=KeyframeStoreConfig)
    offload: OffloadConfig = field(default_factory=OffloadConfig)
    recent_cameras: int = 8  # Number of last keyframes whose visible Gaussians stay in memory.
    prune_keyframes: int = 5  # Keyframes between two prunings.
    # A keyframe pose is published again after the Gaussian optimizer has moved it this far.
    refined_m: float = 2e-4
    refined_rad: float = 2e-4
    seed: int = 0  # Seed of the random choice of keyframes.

    def __post_init__(self) -> None:
        if self.prune_keyframes < 1 or min(self.refined_m, self.refined_rad, self.seed) < 0:
            raise ConfigError(
                named(self, "prune_keyframes", "refined_m", "refined_rad", "seed")
                + ": prune_keyframes must be at least 1, and the others at least 0."
            )
