"""Keyframe poses in the map, as one receiver knows them, and measured poses between keyframes.

Conventions: `ldo_service.geometry`.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import se3
from .point_records import RecordTable

APART_M = 100.0  # between submaps that are not joined: farther than depth cameras see
NO_REFERENCE = -1
KEYFRAME = np.dtype(
    [
        ("id", np.int64),
        ("reference", np.int64),  # that it was measured from
        ("submap", np.int64),
        ("T_map", float, (4, 4)),
        ("T_reference", float, (4, 4)),  # T_reference_keyframe
        ("T_odom", float, (4, 4)),  # T_odom_keyframe
    ]
)


def T_map_submap(submap: int) -> np.ndarray:
    """Where the odometry frame of a submap is put [4, 4] until it is joined to an older one.

    Below, for a building goes on sideways, and far from all others, so that their surfaces do not
    meet; float32 still resolves 0.1 mm in the tenth of them.
    """
    T = np.eye(4)
    T[1, 3] = submap * APART_M
    return T


class KeyframePoses:
    """T_map_keyframe by id, chained from relative measurements and replaced by corrections.

    Every receiver of keyframes keeps one. Two receivers that know the same keyframes and the same
    correction agree, whatever the order in which these arrived. Grows by 0.4 kB a keyframe.
    """

    def __init__(self) -> None:
        self.version = 0  # of the last correction
        self._known = RecordTable(KEYFRAME)

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._known

    def __getitem__(self, keyframe: int) -> np.ndarray:
        """T_map_keyframe [4, 4]."""
        return self._record(keyframe)["T_map"].copy()

    def __iter__(self) -> Iterator[int]:
        """Ascending."""
        return iter(self._known.ids.tolist())

    def of(self, keyframes: Collection[int]) -> np.ndarray:
        """T_map_keyframe [n, 4, 4] of known ones."""
        return self._known.all["T_map"][self._known.rows(keyframes)]

    def are_known(self, keyframes: Collection[int]) -> np.ndarray:
        """[n] bool of n keyframes."""
        return self._known.are_known(keyframes)

    def add(
        self,
        keyframe: int,
        reference: int | None,
        T_reference_keyframe: np.ndarray,
        T_odom_keyframe: np.ndarray,
        submap: int = 0,
    ) -> np.ndarray:
        """Place a new keyframe; its T_map_keyframe.

        A reference that is not known was missed: odometry to the newest known one of the submap
        stands in.
        """
        measured_from = NO_REFERENCE if reference is None else reference
        measured = (measured_from, submap, np.eye(4), T_reference_keyframe, T_odom_keyframe)
        newest = self._newest(submap)
        self._known.put(keyframe, *measured)
        record = self._record(keyframe)
        record["T_map"] = self._placed(record, newest)
        return self[keyframe]

    def place(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """Put a known keyframe elsewhere, and its link with it, until a correction says more."""
        record = self._record(keyframe)
        record["T_map"] = T_map_keyframe
        reference = int(record["reference"])
        if reference in self:
            record["T_reference"] = se3.inverse(self[reference]) @ T_map_keyframe

    def correct(
        self, version: int, T_map: Mapping[int, np.ndarray], held: Collection[int] = ()
    ) -> None:
        """Take over a correction.

        Keyframes that are newer than the newest it names are chained again from their references,
        and so are those `held`, whose links are better than what the correction knew; one without
        a known reference has no such link. An older correction than the last changes nothing.
        """
        if version <= self.version or not T_map:
            return
        self.version = version
        records = self._known.all
        is_held = np.isin(records["id"], list(held)) & np.isin(records["reference"], records["id"])
        named = np.fromiter(T_map, np.int64)
        order = np.argsort(named)
        is_known = np.isin(named[order], records["id"], assume_unique=True)
        rows = self._known.rows(named[order])
        T_new = np.array(list(T_map.values()))[order[is_known]]
        records["T_map"][rows[~is_held[rows]]] = T_new[~is_held[rows]]
        for record in records[(records["id"] > named.max()) | is_held]:
            keyframe, submap = int(record["id"]), int(record["submap"])
            placed = self._placed(record, self._newest(submap, keyframe))
            self._record(keyframe)["T_map"] = placed

    def _record(self, keyframe: int) -> np.void:
        """To be read and written. Raises KeyError when it is not known."""
        row = self._known.row(keyframe)
        if row is None:
            raise KeyError(keyframe)
        return self._known.all[row]

    def _placed(self, record: np.void, newest: int | None) -> np.ndarray:
        """T_map_keyframe through its reference; without one through odometry from `newest`."""
        reference = int(record["reference"])
        if reference in self:
            T_map = self[reference] @ record["T_reference"]
        elif newest is not None:
            T_map = self.T_map_odom(newest) @ record["T_odom"]
        else:
            T_map = T_map_submap(int(record["submap"])) @ record["T_odom"]
        return se3.orthonormalize(T_map)

    def _newest(self, submap: int, before: float = math.inf) -> int | None:
        """The newest keyframe of a submap among those older than `before`."""
        records = self._known.all
        known = records["id"][(records["id"] < before) & (records["submap"] == submap)]
        return int(known[-1]) if len(known) else None

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Forget all others, for a receiver that needs a few."""
        self._known.keep_only(keyframes)

    def T_map_odom(self, keyframe: int) -> np.ndarray:
        """The odometry frame in the map [4, 4], as seen at a keyframe."""
        record = self._record(keyframe)
        return record["T_map"] @ se3.inverse(record["T_odom"])

    def snapshot(self) -> dict[str, Any]:
        return {"version": self.version, **self._known.columns()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.version = state["version"]
        self._known.restore(state)


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Measured T_a_b [4, 4] with its information [6, 6]: rotation, then translation, at b."""

    a: int
    b: int
    T_a_b: np.ndarray
    information: np.ndarray
