"""Work after pose corrections: deduplication of Gaussians and refit iterations."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses

from .map_builder import MapBuilder

# Factors that turn the three indices of a cube into one number, unique for indices up to a million.
CUBE_STRIDES = np.array([1 << 42, 1 << 21, 1], np.int64)


@dataclass(frozen=True, slots=True)
class LoopRefitConfig:
    """Settings of the deduplication and the refit after pose corrections."""

    # A keyframe is deduplicated and refitted if it moves relative to its surroundings by more than
    # this distance or angle. Normal iterations correct smaller motions.
    min_motion_m: float = 0.01
    min_motion_rad: float = 0.01
    # Edge of the cubes in which motions are compared, meters. A correction of less than 0.5 % of
    # the path length bends the map by less than `min_motion_m` within a cube.
    cube_m: float = 2.0
    # Number of keyframes that are deduplicated with each new keyframe. The deduplication of 100
    # displaced keyframes thus ends after 50 new ones.
    deduplicated_per_keyframe: int = 2
    # Maximum number of keyframes that are deduplicated at the end, newest first; takes some
    # seconds.
    deduplicated_at_end: int = 200
    # Iterations after the deduplication of each keyframe: as many as `MapperConfig.min_iterations`
    # guarantees to a new keyframe.
    deduplication_iterations: int = 3
    # Refit iterations for each displaced keyframe, half of them on other keyframes.
    iterations: int = 12
    # Number of pending refit iterations that run with each new keyframe if no further keyframe
    # waits; mapping then takes 50 % longer. The other pending iterations run while no keyframe
    # arrives, and at the end of offline runs.
    iterations_per_keyframe: int = 6
    # Number of pending refit iterations that run in one go while no keyframe arrives. They delay
    # the next keyframe by at most 0.8 s, measured on two cores at 640x480.
    iterations_while_idle: int = 12

    def __post_init__(self) -> None:
        if min(getattr(self, name) for name in self.__slots__) < 0:
            raise ConfigError(named(self, *self.__slots__) + " must not be negative.")
        if self.cube_m == 0:
            raise ConfigError(named(self, "cube_m") + " must be positive.")


def displaced_mask(T_now: np.ndarray, T_before: np.ndarray, config: LoopRefitConfig) -> np.ndarray:
    """Return which keyframes moved far relative to the oldest keyframe in the same cube of space.

    A boundary between two cubes may separate keyframes of the same place. Two grids of cubes are
    therefore used, and the second grid is shifted by half an edge along each axis.

    Args:
        T_now: Poses T_map_keyframe after the correction, [K, 4, 4], oldest first.
        T_before: Poses before the correction, [K, 4, 4].
        config: Settings.

    Returns:
        [K] bool.
    """
    motions = T_now @ se3.inverse(T_before)
    is_displaced = np.zeros(len(T_now), bool)
    for shift in (0.0, 0.5):
        cubes = np.floor(T_now[:, :3, 3] / config.cube_m + shift).astype(np.int64)
        _, oldest, cube = np.unique(cubes @ CUBE_STRIDES, return_index=True, return_inverse=True)
        T_as_oldest = motions[oldest[cube]] @ T_before
        is_displaced |= se3.transforms_differ(
            T_now, T_as_oldest, config.min_motion_m, config.min_motion_rad
        )
    return is_displaced


class LoopRefit:
    """Scheduler of the deduplication and refit iterations after pose corrections.

    The Gaussians of a keyframe move with it. A part of the map that a correction moves as a whole
    stays as good as it was. Work is needed where keyframes that see the same surface move
    differently, such as on both sides of a loop closure. A keyframe counts as displaced if it
    moves far relative to the oldest keyframe in the same cube of space.

    Deduplication. After a correction, the Gaussians of a displaced keyframe may duplicate older
    Gaussians of the same surface. The keyframe is queued for deduplication.

    Refit. A displaced keyframe gets pending refit iterations. Half of them optimize against this
    keyframe, the other half against random keyframes. Optimizing against displaced keyframes alone
    would make the map worse at other keyframes that show the same surface and did not move.

    This work is done in small amounts with each following keyframe, so that new keyframes are
    mapped without long delays.
    """

    def __init__(self, map_: MapBuilder, config: LoopRefitConfig | None = None) -> None:
        self.config = config or LoopRefitConfig()
        self._map = map_
        self._deduplicated = 0  # Duplicate Gaussians removed.
        self._to_deduplicate: list[int] = []  # Keyframes to deduplicate, ascending.
        self._pending: dict[int, int] = {}  # Pending refit iterations by keyframe.

    def mark_moved(self, T_map: KeyframePoses) -> None:
        """Schedule deduplication and refit for the keyframes that a correction displaces.

        Call this method before `MapBuilder.move_keyframes` applies the correction to the map.

        Args:
            T_map: The corrected poses of the keyframes.
        """
        placed, config = self._map.views.poses, self.config
        is_displaced = displaced_mask(T_map.of(placed), placed.of(placed), config)
        displaced = np.fromiter(placed, np.int64)[is_displaced].tolist()
        self._to_deduplicate = sorted({*self._to_deduplicate, *displaced})
        self._pending |= dict.fromkeys(displaced, config.iterations)
        self._forget()

    def _forget(self) -> None:
        """Drop keyframes without pending iterations or without images."""
        stored = self._map.views.store  # Unlike `views.cameras`, it lacks unreadable keyframes.
        self._pending = {k: left for k, left in self._pending.items() if left > 0 and k in stored}

    @property
    def pending_iterations(self) -> int:
        """Number of pending refit iterations, at most `config.iterations` per keyframe."""
        return sum(self._pending.values())

    @property
    def deduplication_iterations(self) -> int:
        """Number of optimizer iterations that `with_keyframe` will run after deduplication."""
        config = self.config
        return config.deduplication_iterations * min(
            config.deduplicated_per_keyframe, len(self._to_deduplicate)
        )

    def with_keyframe(self, *, is_behind: bool) -> None:
        """Run the deduplication and the refit iterations that are due after a new keyframe.

        Args:
            is_behind: True if more new keyframes wait to be mapped. Refit iterations are then
                postponed.
        """
        config = self.config
        self._deduplicate(config.deduplicated_per_keyframe, config.deduplication_iterations)
        if not self._pending or is_behind:
            return
        limit = config.iterations_per_keyframe
        runnable = sum(self._pending[k] for k in self._resident_keyframes())
        if runnable:
            self.refine(min(limit, runnable), effort=limit)

    def has_work(self) -> bool:
        """Return whether keyframes wait for deduplication or for refit iterations.

        Refit iterations of keyframes that may see offloaded Gaussians do not count. They wait until
        the camera comes near and these Gaussians are loaded.
        """
        return bool(self._to_deduplicate) or bool(self._resident_keyframes())

    def while_idle(self) -> None:
        """Do a part of the pending deduplication and refit while no keyframe arrives."""
        config = self.config
        self._deduplicate(config.deduplicated_per_keyframe, config.deduplication_iterations)
        runnable = sum(self._pending[k] for k in self._resident_keyframes())
        if runnable:
            self.refine(min(config.iterations_while_idle, runnable))

    def at_end(self) -> None:
        """Remove duplicate Gaussians at the end of the run, without iterations of the optimizer.

        Iterations could change keyframe poses, which are no longer published at the end.
        """
        self._deduplicate(self.config.deduplicated_at_end, iterations=0)

    def _deduplicate(self, limit: int, iterations: int) -> None:
        """Deduplicate at most `limit` keyframes, newest first, and run `iterations` after each."""
        for _ in range(min(limit, len(self._to_deduplicate))):
            self._deduplicated += self._map.deduplicate_keyframe(
                self._to_deduplicate.pop(), iterations
            )

    def refine(
        self, iterations: int, rates: tuple[float, float] = (1.0, 1.0), effort: float = inf
    ) -> None:
        """Run iterations of the Gaussian optimizer.

        While refit iterations are pending, they alternate with iterations on random keyframes. See
        `MapBuilder.refine` for the arguments.
        """
        resident = self._resident_keyframes()
        visits = np.repeat(resident, [-(-self._pending[k] // 2) for k in resident]).astype(np.int64)
        order = np.random.default_rng(self.pending_iterations).permutation(visits)
        displaced = order[: -(-iterations // 2)].tolist()
        done = self._map.refine(iterations, rates, first=displaced, effort=effort)
        for keyframe, visited in Counter(displaced[: -(-done // 2)]).items():
            self._pending[keyframe] -= 2 * visited
        self._forget()

    def _resident_keyframes(self) -> list[int]:
        """Return the keyframes with pending iterations that cannot see offloaded Gaussians.

        The map cannot be fitted to the other keyframes until their offloaded Gaussians are loaded.
        """
        self._forget()
        return [k for k in self._pending if self._map.is_resident(k)]

    def snapshot(self) -> dict[str, Any]:
        return {"to_deduplicate": list(self._to_deduplicate), "pending": dict(self._pending)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._to_deduplicate = list(state["to_deduplicate"])
        self._pending = dict(state["pending"])

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes_to_deduplicate": len(self._to_deduplicate),
            # Number of duplicate Gaussians that were removed after corrections.
            "gaussians_deduplicated": self._deduplicated,
            # Pending iterations to refit the map to keyframes that corrections moved.
            "iterations_pending": self.pending_iterations,
        }
