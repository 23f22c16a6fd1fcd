"""Work after pose corrections: deduplication of Gaussians and refit iterations."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses

from .map_builder import MapBuilder


@dataclass(frozen=True, slots=True)
class LoopRefitConfig:
    """Settings of the refit; see the fields of these names in `MapperConfig`."""

    mending_min_m: float
    mending_min_rad: float
    mended_keyframes: int
    mended_at_end: int
    mending_iterations: int
    due_iterations: int
    paid_iterations: int


class LoopRefit:
    """Scheduler of the deduplication and refit iterations after pose corrections.

    A keyframe that a correction moves far may overlap surface that the map already holds. It is
    queued for deduplication.

    The first keyframe holds the map frame. A keyframe that moves far relative to it gets pending
    refit iterations, because the map was fitted to the old relative poses. Half of its iterations
    take this keyframe, half take any keyframe. Unmoved keyframes see the same surface: fitting to
    the moved ones alone would make the map worse for them.

    The work is spread over the following keyframes, to keep the latency of new keyframes low.
    """

    def __init__(self, map_: MapBuilder, config: LoopRefitConfig) -> None:
        self.config = config
        self._map = map_
        self._mended = 0  # Duplicate Gaussians removed.
        self._to_mend: list[int] = []  # Keyframes to deduplicate, ascending.
        self._due: dict[int, int] = {}  # Pending refit iterations by keyframe.

    def mark_moved(self, T_map: KeyframePoses) -> None:
        """Schedule work for the keyframes that a correction moves far.

        Call it before the Gaussians move with their anchors.

        Args:
            T_map: The corrected poses of the keyframes.
        """
        placed, config = self._map.views.poses, self.config
        keyframes = np.fromiter(placed, np.int64)
        T_now, T_before = T_map.of(placed), placed.of(placed)
        least = config.mending_min_m, config.mending_min_rad
        far = keyframes[se3.transforms_differ(T_now, T_before, *least)]
        if not len(far):
            return
        self._to_mend = sorted({*self._to_mend, *far.tolist()})
        T_as_a_whole = T_now[0] @ se3.inverse(T_before[0])
        torn = keyframes[se3.transforms_differ(T_now, T_as_a_whole @ T_before, *least)]
        self._due |= dict.fromkeys(torn.tolist(), config.due_iterations)
        self._forget()

    def _forget(self) -> None:
        """Drop keyframes without pending iterations or without images."""
        known = self._map.views.cameras
        self._due = {k: left for k, left in self._due.items() if left > 0 and k in known}

    @property
    def pending_iterations(self) -> int:
        """Number of pending refit iterations.

        It is at most `due_iterations` for each keyframe with images.
        """
        return sum(self._due.values())

    @property
    def mending_iterations(self) -> int:
        """Number of iterations after deduplication that run with the next keyframe."""
        config = self.config
        return config.mending_iterations * min(config.mended_keyframes, len(self._to_mend))

    def with_keyframe(self, *, is_behind: bool) -> None:
        """Do the part of the work that belongs to one new keyframe.

        Args:
            is_behind: More keyframes are queued; pending refit iterations then wait.
        """
        self._deduplicate(self.config.mended_keyframes, self.config.mending_iterations)
        if not self._due or is_behind:
            return
        most = self.config.paid_iterations
        payable = sum(self._due[k] for k in self._resident_keyframes())
        if payable:
            self.refine(min(most, payable), effort=most)

    def at_end(self) -> None:
        """Deduplicate at the end of the run, without iterations.

        Iterations could move keyframes, and no more refinements are published then.
        """
        self._deduplicate(self.config.mended_at_end, iterations=0)

    def _deduplicate(self, most: int, iterations: int) -> None:
        """Deduplicate at most `most` keyframes, the newest first."""
        for _ in range(min(most, len(self._to_mend))):
            self._mended += self._map.deduplicate_keyframe(self._to_mend.pop(), iterations)

    def refine(
        self, iterations: int, rates: tuple[float, float] = (1.0, 1.0), effort: float = inf
    ) -> None:
        """Run iterations of the Gaussian optimizer, pending refit iterations first.

        See `MapBuilder.refine` for the arguments.
        """
        awake = self._resident_keyframes()
        visits = np.repeat(awake, [-(-self._due[k] // 2) for k in awake]).astype(np.int64)
        order = np.random.default_rng(self.pending_iterations).permutation(visits)
        torn = order[: -(-iterations // 2)].tolist()
        done = self._map.refine(iterations, rates, first=torn, effort=effort)
        for keyframe, visited in Counter(torn[: -(-done // 2)]).items():
            self._due[keyframe] -= 2 * visited
        self._forget()

    def _resident_keyframes(self) -> list[int]:
        """Return the keyframes with pending iterations that see no offloaded Gaussians.

        The optimizer cannot fit to the other keyframes.
        """
        self._forget()
        return [k for k in self._due if self._map.is_resident(k)]

    def snapshot(self) -> dict[str, Any]:
        return {"to_mend": list(self._to_mend), "due": dict(self._due)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._to_mend = list(state["to_mend"])
        self._due = dict(state.get("due", {}))  # Missing in old checkpoints.

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes_to_deduplicate": len(self._to_mend),
            # Gaussians held twice after a correction, and removed.
            "gaussians_deduplicated": self._mended,
            # Iterations to refit the map to keyframes that corrections moved.
            "iterations_pending": self.pending_iterations,
        }
