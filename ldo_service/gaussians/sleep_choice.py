"""Which Gaussians leave the memory when there are too many."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError

from .anchor_spheres import AnchorSpheres, PlacedCamera


@dataclass(frozen=True, slots=True)
class SleepConfig:
    max_active: int = 1_500_000  # Gaussians in memory (ALGORITHMS, The map): 300 MB with moments.
    # Between two looks at it, every mapper.changed_keyframes, new and woken ones come on top
    low_water: float = 0.9  # share of max_active that stays: a batch of 0.1 s now and then
    reach_m: float = 20.0  # beyond, nothing counts as seen: depth cameras measure less far, so
    # nothing is inserted a second time where Gaussians sleep. Nearer, what they measured hides
    # what is behind
    clump_m: float = 1.0  # edge of the cubes whose Gaussians of one keyframe sleep and wake
    # together. In a flat of two rooms 36 % of the map may be seen by the last 8 keyframes, with 0.5
    # 28 %, with 2.0 54 %; 67 % with whole keyframes and without a look at what hides them

    def __post_init__(self) -> None:
        if not (self.max_active >= 1 and 0 < self.low_water <= 1):
            raise ConfigError(f"{self}: max_active must be at least 1, low_water in (0, 1].")
        if not (self.reach_m > 0 and self.clump_m > 0):
            raise ConfigError(f"{self}: reach_m and clump_m must be positive.")


@dataclass(frozen=True, slots=True)
class SleepChoice:
    """clumps   numbers of the spheres whose Gaussians go to sleep, the farthest first
    excess   Gaussians over max_active that stay, because they may be looked at
    """

    clumps: list[int]
    excess: int


def choose_sleepers(
    awake: AnchorSpheres,
    recent: Sequence[PlacedCamera],
    config: SleepConfig,
) -> SleepChoice:
    """Nobody up to `max_active` Gaussians; over it, clumps until `low_water` of that is left.

    awake   of all Gaussians in memory, by clump
    recent  cameras of the last keyframes, at least the current one, which is last

    Those that no recent camera may see go, the farthest from the current camera first, older ones
    before newer ones at the same distance. Those of the newest anchor never go. Deterministic.
    """
    active = int(awake.counts.sum())
    if active <= config.max_active:
        return SleepChoice([], 0)
    looked_at = awake.anchors == awake.anchors[-1]
    for camera in recent:
        looked_at |= camera.may_see(awake.centers, awake.radii_m, config.reach_m)
    idle = np.flatnonzero(~looked_at)
    distances_m = recent[-1].distances_m(awake.centers[idle], awake.radii_m[idle])
    chosen: list[int] = []
    for k in idle[np.argsort(-distances_m, kind="stable")]:
        if active <= config.low_water * config.max_active:
            break
        chosen.append(int(k))
        active -= int(awake.counts[k])
    return SleepChoice(chosen, max(0, active - config.max_active))
