"""Parameters of the pose graph: noise, loop closures, condensation and rebuilds."""

from dataclasses import dataclass, field

from ldo_service.errors import ConfigError, named

from .factors import NoiseConfig
from .loop_closures import LoopClosureConfig


@dataclass(frozen=True, slots=True)
class PoseGraphConfig:
    """Parameters of the pose graph.

    The pose of a keyframe is a variable of the graph until the keyframe is condensed. The pose of a
    condensed keyframe is interpolated between the variables before and after it.
    """

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    closures: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    # Keyframes per group (LDO-SLAM paper, III.C: 10). The first one stays a variable; the others
    # are condensed.
    condense_keyframes: int = 10
    # Number of newest keyframes that are not condensed, because their measurements still change.
    window_keyframes: int = 20
    # A condensed keyframe becomes a variable again, which splits its group, if a loop closure
    # changes its pose relative to its two variables by more than this number of sigmas of a loop
    # closure. No group is split if there is already one group per `keyframes_each` keyframes, to
    # bound the solver's time.
    max_interpolation_sigmas: float = 0.1
    keyframes_each: int = 5  # Minimum keyframes per group, on average, for a group to be split.
    # Maximum number of changes of the graph between two rebuilds of the solver. A restored graph
    # repeats the changes since the last rebuild, with bitwise equal results.
    max_changes: int = 64

    def __post_init__(self) -> None:
        counts = self.condense_keyframes, self.window_keyframes, self.max_changes
        if min(*counts, self.keyframes_each) < 1:
            raise ConfigError(
                named(
                    self, "condense_keyframes", "window_keyframes", "keyframes_each", "max_changes"
                )
                + ": condense_keyframes, window_keyframes, keyframes_each and max_changes must be "
                "at least 1."
            )
        if self.max_interpolation_sigmas < 0:
            raise ConfigError(named(self, "max_interpolation_sigmas") + " must not be negative.")
