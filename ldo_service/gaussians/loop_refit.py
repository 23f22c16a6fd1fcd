"""What corrections leave to do: surface that the map holds twice, and views it no longer fits."""

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
    """See the fields of these names in `MapperConfig`."""

    mending_min_m: float
    mending_min_rad: float
    mended_keyframes: int
    mended_at_end: int
    mending_iterations: int
    due_iterations: int
    paid_iterations: int


class LoopRefit:
    """Of a map that is corrected now and then.

    A keyframe that a correction moves far may lie over surface that the map holds already: it is to
    be mended. One that it moves far against the first, which holds the frame of the map, is torn:
    the map was fitted to it and others where they are no longer, and is due some iterations for it,
    half of them against it, half against any keyframe. What is left as it was sees the same
    surface, and would be bent to fit the torn ones alone. All is done little by little, so that new
    keyframes wait no longer than they must.
    """

    def __init__(self, map_: MapBuilder, config: LoopRefitConfig) -> None:
        self.config = config
        self._map = map_
        self._mended = 0  # Gaussians that the map held twice
        self._to_mend: list[int] = []  # keyframes, ascending
        self._due: dict[int, int] = {}  # iterations by torn keyframe

    def mark_moved(self, T_map: KeyframePoses) -> None:
        """Before the Gaussians of keyframes are moved to where these are by now."""
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
        """Those that are through, and those without images."""
        known = self._map.views.cameras
        self._due = {k: left for k, left in self._due.items() if left > 0 and k in known}

    @property
    def pending_iterations(self) -> int:
        """Iterations, at most `due_iterations` for each keyframe with images."""
        return sum(self._due.values())

    @property
    def mending_iterations(self) -> int:
        """That are done with the next keyframe."""
        config = self.config
        return config.mending_iterations * min(config.mended_keyframes, len(self._to_mend))

    def with_keyframe(self, *, is_behind: bool) -> None:
        """A share of the work; what is due waits while keyframes do (`is_behind`)."""
        self._deduplicate(self.config.mended_keyframes, self.config.mending_iterations)
        if not self._due or is_behind:
            return
        most = self.config.paid_iterations
        payable = sum(self._due[k] for k in self._resident_keyframes())
        if payable:
            self.refine(min(most, payable), effort=most)

    def at_end(self) -> None:
        """Without iterations: they could move keyframes, and nobody takes a refinement any more."""
        self._deduplicate(self.config.mended_at_end, iterations=0)

    def _deduplicate(self, most: int, iterations: int) -> None:
        """The newest first."""
        for _ in range(min(most, len(self._to_mend))):
            self._mended += self._map.deduplicate_keyframe(self._to_mend.pop(), iterations)

    def refine(
        self, iterations: int, rates: tuple[float, float] = (1.0, 1.0), effort: float = inf
    ) -> None:
        """Iterations of the optimiser, see `MapBuilder.refine`: first those that are due."""
        awake = self._resident_keyframes()
        visits = np.repeat(awake, [-(-self._due[k] // 2) for k in awake]).astype(np.int64)
        order = np.random.default_rng(self.pending_iterations).permutation(visits)
        torn = order[: -(-iterations // 2)].tolist()
        done = self._map.refine(iterations, rates, first=torn, effort=effort)
        for keyframe, visited in Counter(torn[: -(-done // 2)]).items():
            self._due[keyframe] -= 2 * visited
        self._forget()

    def _resident_keyframes(self) -> list[int]:
        """Torn keyframes that see nothing that sleeps: nothing can be fitted to the others."""
        self._forget()
        return [k for k in self._due if self._map.is_resident(k)]

    def snapshot(self) -> dict[str, Any]:
        return {"to_mend": list(self._to_mend), "due": dict(self._due)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._to_mend = list(state["to_mend"])
        self._due = dict(state.get("due", {}))  # states of old know nothing of it

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes_to_deduplicate": len(self._to_mend),
            "gaussians_deduplicated": self._mended,  # held twice after a correction, and removed
            # to fit the map again where corrections have torn it
            "iterations_pending": self.pending_iterations,
        }
