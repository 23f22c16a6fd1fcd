"""Parameters of the mapper."""

import os
from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.loop_refit import LoopRefitConfig
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.maps.publisher import PublishConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig

# Number of Gaussians that lengthen the interval between two checkpoints by one keyframe. Saving
# them takes about 25 ms, 5 % of the time between two keyframes at 2 Hz.
GAUSSIANS_PER_KEYFRAME = 20_000


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Parameters of the mapper."""

    builder: MapBuilderConfig = field(default_factory=MapBuilderConfig)
    semantics: SemanticMapConfig = field(default_factory=SemanticMapConfig)
    # Effort of the optimizer for each keyframe, in iterations at full resolution. More iterations
    # run, because most of them have half the resolution; fewer run where the map is dense or
    # keyframes wait. With this value, the service reaches 12 FPS on two cores at 640x480.
    iterations: int = 12
    # Minimum iterations per keyframe, however many keyframes wait: new Gaussians need some. With 3,
    # the mapper of the apartment at 2 Hz was so late that the tracker made 10 % fewer keyframes.
    min_iterations: int = 1
    # Folder of the keyframe images; empty: a temporary folder, or one in the state folder.
    folder: str = ""
    threads: int = 0  # Threads of the renderer; 0: as many as the machine has cores.
    publish: PublishConfig = field(default_factory=PublishConfig)
    # Number of newest keyframes for which every relative-pose measurement is updated when the
    # renderer refines their poses. For an older keyframe, only the measurement relative to its
    # reference keyframe is updated, because the pose graph no longer has the others.
    measured_keyframes: int = 64
    # Keyframes between two saved maps, unless the map is large; see `checkpoint_interval`.
    checkpoint_keyframes: int = 5
    # Gaussians move with their anchor keyframe when a correction has moved it by more than this.
    # Smaller motions, below 0.1 px, are not visible.
    motion_min_m: float = 2e-4
    motion_min_rad: float = 2e-4  # Same limit for rotations; equal to MapBuilderConfig.refined_rad.
    refit: LoopRefitConfig = field(default_factory=LoopRefitConfig)

    def __post_init__(self) -> None:
        amounts = ("iterations", "min_iterations", "threads")
        if min(getattr(self, name) for name in amounts) < 0:
            raise ConfigError(named(self, *amounts) + " must not be negative.")
        counts = ("checkpoint_keyframes", "measured_keyframes")
        if min(getattr(self, name) for name in counts) < 1:
            raise ConfigError(named(self, *counts) + " must be at least 1.")

    def checkpoint_interval(self, gaussians: int) -> int:
        """Return the number of keyframes between two saved maps.

        The interval grows with the map, because the size of a saved map does too. After a crash, at
        most this many keyframes are mapped again.

        Args:
            gaussians: Number of Gaussians in memory.
        """
        return max(self.checkpoint_keyframes, gaussians // GAUSSIANS_PER_KEYFRAME)

    def thread_count(self) -> int:
        """Return the number of threads of the renderer."""
        return self.threads or os.cpu_count() or 1
