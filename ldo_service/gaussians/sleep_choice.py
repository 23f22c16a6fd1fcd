"""Which anchors' Gaussians leave the memory when there are too many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError

from .anchor_spheres import AnchorSpheres, PlacedCamera


@dataclass(frozen=True, slots=True)
class SleepConfig:
    max_active: int = 1_500_000  # Gaussians in memory (ALGORITHMS, The map): 300 MB with moments
    low_water: float = 0.9  # share of max_active that stays: a batch of 0.1 s now and then
    reach_m: float = 20.0  # beyond, nothing counts as seen: depth cameras measure less far, so
    # nothing is inserted a second time where Gaussians sleep

    def __post_init__(self) -> None:
        if not (self.max_active >= 1 and 0 < self.low_water <= 1 and self.reach_m > 0):
            raise ConfigError(
                f"{self}: max_active must be at least 1, low_water in (0, 1], reach_m positive."
            )


@dataclass(frozen=True, slots=True)
class SleepChoice:
    """anchors  that go to sleep, the farthest first
    excess   Gaussians over max_active that stay, because they may be looked at
    """

    anchors: list[int]
    excess: int


def choose_sleepers(
    awake: AnchorSpheres,
    T_map_anchor: Mapping[int, np.ndarray],
    recent: Sequence[PlacedCamera],
    config: SleepConfig,
) -> SleepChoice:
    """Nobody up to `max_active` Gaussians; over it, anchors until `low_water` of that is left.

    awake         of all Gaussians in memory
    T_map_anchor  per anchor its pose [4, 4]
    recent        cameras of the last keyframes, at least the current one, which is last

    Those that no recent camera may see go, the farthest from the current camera first, older ones
    before newer ones at the same distance. The newest anchor never goes. Deterministic.
    """
    active = int(awake.counts.sum())
    if active <= config.max_active:
        return SleepChoice([], 0)
    centers = awake.centers_map(T_map_anchor)
    looked_at = awake.anchors == awake.anchors[-1]
    for camera in recent:
        looked_at |= camera.may_see(centers, awake.radii_m, config.reach_m)
    idle = np.flatnonzero(~looked_at)
    distances_m = recent[-1].distances_m(centers[idle], awake.radii_m[idle])
    chosen: list[int] = []
    for k in idle[np.argsort(-distances_m, kind="stable")]:
        if active <= config.low_water * config.max_active:
            break
        chosen.append(int(awake.anchors[k]))
        active -= int(awake.counts[k])
    return SleepChoice(chosen, max(0, active - config.max_active))
