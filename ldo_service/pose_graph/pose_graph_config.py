"""Parameters of the pose graph: noise, loop closures, condensation and rebuilds."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .factors import NoiseConfig
from .loop_closures import LoopClosureConfig


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Parameters of the pose graph."""

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    closures: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    # Keyframes per group; one stays a variable (paper, III.C: every 10).
    condense_keyframes: int = 10
    window_keyframes: int = 20  # Newest keyframes, not condensed: their measurements still change.
    # A condensed keyframe becomes a variable again if a closure changes it by more sigmas than
    # this. There is at most one group per `keyframes_each` keyframes, to bound the solver's time.
    max_interpolation_sigmas: float = 0.1
    keyframes_each: int = 5
    max_changes: int = 64  # Number between two rebuilds; a restored graph repeats them bit by bit.

    def __post_init__(self) -> None:
        counts = self.condense_keyframes, self.window_keyframes, self.max_changes
        if min(*counts, self.keyframes_each) < 1:
            raise ConfigError(
                named(
                    self, "condense_keyframes", "window_keyframes", "keyframes_each", "max_changes"
                )
                + " must be at least 1."
            )
        if self.max_interpolation_sigmas < 0:
            raise ConfigError(named(self, "max_interpolation_sigmas") + " must not be negative.")
