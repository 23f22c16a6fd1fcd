"""Parameters of the mapper."""

import os
from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named
from ldo_service.gaussians.loop_refit import LoopRefitConfig
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.maps.publisher import PublishConfig
from ldo_service.semantics.semantic_map import SemanticMapConfig


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Parameters of the mapper."""

    builder: MapBuilderConfig = field(default_factory=MapBuilderConfig)
    semantics: SemanticMapConfig = field(default_factory=SemanticMapConfig)
    # Effort of the optimizer for each keyframe, in iterations at full resolution. More iterations
    # run, because most of them have half the resolution; fewer run where the map is dense or
    # keyframes wait. With this value, the service reaches 12 FPS on two cores at 640x480.
    iterations: int = 12
    # Minimum iterations per keyframe, however many keyframes wait: new Gaussians need some.
    min_iterations: int = 3
    # Folder of the keyframe images; empty: a temporary folder, or one in the state folder.
    folder: str = ""
    threads: int = 0  # Threads of the renderer; 0: as many as the machine has cores.
    publish: PublishConfig = field(default_factory=PublishConfig)
    # Number of newest keyframes for which every relative-pose measurement is updated when the
    # renderer refines their poses. For an older keyframe, only the measurement relative to its
    # reference keyframe is updated, because the pose graph no longer has the others.
    measured_keyframes: int = 64
    # Keyframes between two saved maps. After a crash, at most this many are mapped again.
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

    def thread_count(self) -> int:
        """Return the number of threads of the renderer."""
        return self.threads or os.cpu_count() or 1
