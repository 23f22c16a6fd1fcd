"""Where keyframes are in the map, as one receiver knows it. Conventions: `ldo_service.geometry`."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from . import se3

APART_M = 100.0  # between segments that are not joined: farther than depth cameras see


@dataclass(frozen=True, slots=True)
class Link:
    """How a keyframe was measured: T_reference_keyframe and T_odom_keyframe [4, 4]."""

    reference: int | None
    T_reference_keyframe: np.ndarray
    T_odom_keyframe: np.ndarray
    segment: int = 0


def T_map_segment(segment: int) -> np.ndarray:
    """Where the odometry frame of a segment is put [4, 4] until it is joined to an older one.

    Below, for a building goes on sideways, and far from all others, so that their surfaces do not
    meet; float32 still resolves 0.1 mm in the tenth of them.
    """
    T = np.eye(4)
    T[1, 3] = segment * APART_M
    return T


class KeyframePoses:
    """T_map_keyframe by id, chained from relative measurements and replaced by corrections.

    Every receiver of keyframes keeps one. Two receivers that know the same keyframes and the same
    correction agree, whatever the order in which these arrived. Grows by 0.6 kB a keyframe.
    """

    def __init__(self) -> None:
        self.version = 0  # of the last correction
        self._T_map: dict[int, np.ndarray] = {}
        self._links: dict[int, Link] = {}

    def __len__(self) -> int:
        return len(self._T_map)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._T_map

    def __getitem__(self, keyframe: int) -> np.ndarray:
        """T_map_keyframe [4, 4]."""
        return self._T_map[keyframe]

    def __iter__(self) -> Iterator[int]:
        return iter(self._T_map)

    def chain(
        self,
        keyframe: int,
        reference: int | None,
        T_reference_keyframe: np.ndarray,
        T_odom_keyframe: np.ndarray,
        segment: int = 0,
    ) -> np.ndarray:
        """Place a new keyframe; its T_map_keyframe.

        A reference that is not known was missed: odometry to the newest known one of the segment
        stands in.
        """
        link = Link(reference, np.array(T_reference_keyframe), np.array(T_odom_keyframe), segment)
        self._T_map[keyframe] = self._placed(link, self._newest(segment))
        self._links[keyframe] = link
        return self._T_map[keyframe]

    def place(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """Put a known keyframe elsewhere, and its link with it, until a correction says more."""
        self._T_map[keyframe] = T_map_keyframe
        link = self._links[keyframe]
        if link.reference is not None and link.reference in self._T_map:
            T_reference_keyframe = se3.inverse(self._T_map[link.reference]) @ T_map_keyframe
            self._links[keyframe] = replace(link, T_reference_keyframe=T_reference_keyframe)

    def correct(
        self, version: int, T_map: Mapping[int, np.ndarray], held: Collection[int] = ()
    ) -> dict[int, np.ndarray]:
        """Take over a correction; T_new_old of every known keyframe that it places anew.

        Keyframes that are newer than the newest it names are chained again from their references,
        and so are those `held`, whose links are better than what the correction knew; one without
        a known reference has no such link. An older correction than the last changes nothing.
        """
        if version <= self.version or not T_map:
            return {}
        self.version = version
        newest = max(T_map)
        old = dict(self._T_map)
        held = {k for k in held if k in old and self._links[k].reference in old}
        self._T_map.update({k: T for k, T in T_map.items() if k in old and k not in held})
        for keyframe in sorted(k for k in old if k > newest or k in held):
            link = self._links[keyframe]
            self._T_map[keyframe] = self._placed(link, self._newest(link.segment, keyframe))
        placed = [k for k, T_old in old.items() if self._T_map[k] is not T_old]
        T_new = np.array([self._T_map[k] for k in placed]).reshape(-1, 4, 4)
        T_old = np.array([old[k] for k in placed]).reshape(-1, 4, 4)
        return dict(zip(placed, T_new @ se3.inverse(T_old), strict=True))

    def _placed(self, link: Link, newest: int | None) -> np.ndarray:
        """T_map_keyframe through its reference; without one through odometry from `newest`."""
        if link.reference is not None and link.reference in self._T_map:
            T_map = self._T_map[link.reference] @ link.T_reference_keyframe
        elif newest is not None:
            T_map = self.T_map_odom(newest) @ link.T_odom_keyframe
        else:
            T_map = T_map_segment(link.segment) @ link.T_odom_keyframe
        return se3.orthonormalised(T_map)

    def _newest(self, segment: int, before: float = math.inf) -> int | None:
        """The newest keyframe of a segment among those older than `before`."""
        known = (k for k in self._T_map if k < before and self._links[k].segment == segment)
        return max(known, default=None)

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Forget all others, for a receiver that needs a few."""
        kept = [k for k in keyframes if k in self._T_map]
        self._T_map = {k: self._T_map[k] for k in kept}
        self._links = {k: self._links[k] for k in kept}

    def T_map_odom(self, keyframe: int) -> np.ndarray:
        """The odometry frame in the map [4, 4], as seen at a keyframe."""
        return self._T_map[keyframe] @ se3.inverse(self._links[keyframe].T_odom_keyframe)

    def snapshot(self) -> dict[str, Any]:
        links = list(self._links.values())
        return {
            "version": self.version,
            "keyframes": list(self._T_map),
            "T_map": np.array(list(self._T_map.values())).reshape(-1, 4, 4),
            "reference": [link.reference for link in links],
            "T_reference": np.array([k.T_reference_keyframe for k in links]).reshape(-1, 4, 4),
            "segment": [link.segment for link in links],
            "T_odom": np.array([link.T_odom_keyframe for link in links]).reshape(-1, 4, 4),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self.version = state["version"]
        self._T_map = dict(zip(state["keyframes"], state["T_map"], strict=True))
        columns = (state[name] for name in ("reference", "T_reference", "T_odom", "segment"))
        links = map(Link, *columns)
        self._links = dict(zip(state["keyframes"], links, strict=True))
