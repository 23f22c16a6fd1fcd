"""Keyframe poses in the map, and relative-pose measurements between keyframes.

Conventions: `ldo_service.geometry`.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import se3
from .point_records import RecordTable

APART_M = 100.0  # Distance between unmerged submaps: beyond the range of depth cameras.
NO_REFERENCE = -1  # Stored if a keyframe has no reference keyframe.
KEYFRAME = np.dtype(
    [
        ("id", np.int64),
        ("reference", np.int64),  # Id of the reference keyframe, or NO_REFERENCE.
        ("submap", np.int64),
        ("T_map", float, (4, 4)),  # T_map_keyframe.
        ("T_reference", float, (4, 4)),  # T_reference_keyframe.
        ("T_odom", float, (4, 4)),  # T_odom_keyframe.
    ]
)


def T_map_submap(submap: int) -> np.ndarray:
    """Return the provisional pose [4, 4] of a submap that is not merged with an older one.

    Each submap is placed 100 m below the previous one, so that their surfaces do not touch. The
    offset is vertical, because buildings extend mostly sideways. In the tenth submap, float32
    coordinates still resolve 0.1 mm.
    """
    T = np.eye(4)
    T[1, 3] = submap * APART_M
    return T


class KeyframePoses:
    """Keyframe poses in the map by id, from relative poses and corrections of the pose graph.

    Each program or actor that receives keyframes has its own instance. Two instances with the same
    keyframes and the same last correction have equal poses, in whatever order the keyframes and the
    correction arrived. An instance needs 0.4 kB of memory per keyframe.
    """

    def __init__(self) -> None:
        self.version = 0  # Graph version of the last correction; 0 before the first one.
        self._known = RecordTable(KEYFRAME)

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._known

    def __getitem__(self, keyframe: int) -> np.ndarray:
        """Return T_map_keyframe [4, 4]."""
        return self._record(keyframe)["T_map"].copy()

    def __iter__(self) -> Iterator[int]:
        """Iterate over the ids in ascending order."""
        return iter(self._known.ids.tolist())

    def of(self, keyframes: Collection[int]) -> np.ndarray:
        """Return T_map_keyframe [n, 4, 4] of those given keyframes that are known."""
        return self._known.all["T_map"][self._known.rows(keyframes)]

    def are_known(self, keyframes: Collection[int]) -> np.ndarray:
        """Return which of n keyframes are known, [n] bool."""
        return self._known.are_known(keyframes)

    def add(
        self,
        keyframe: int,
        reference: int | None,
        T_reference_keyframe: np.ndarray,
        T_odom_keyframe: np.ndarray,
        submap: int = 0,
    ) -> np.ndarray:
        """Add a keyframe, and return its T_map_keyframe [4, 4].

        The reference keyframe is unknown if its message was missed. The pose then comes from
        odometry, relative to the newest known keyframe of the submap.

        Args:
            keyframe: Id of the keyframe.
            reference: Reference keyframe of the relative pose; None if the keyframe has none.
            T_reference_keyframe: Relative pose, [4, 4].
            T_odom_keyframe: Pose in the odometry frame, [4, 4].
            submap: Submap of the keyframe.
        """
        measured_from = NO_REFERENCE if reference is None else reference
        measured = (measured_from, submap, np.eye(4), T_reference_keyframe, T_odom_keyframe)
        newest = self._newest(submap)
        self._known.put(keyframe, *measured)
        record = self._record(keyframe)
        record["T_map"] = self._placed(record, newest)
        return self[keyframe]

    def place(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """Set the pose of a known keyframe; the next correction may change it again.

        The stored pose relative to the reference keyframe changes accordingly.

        Args:
            keyframe: Id of the keyframe.
            T_map_keyframe: New pose, [4, 4].
        """
        record = self._record(keyframe)
        record["T_map"] = T_map_keyframe
        reference = int(record["reference"])
        if reference in self:
            record["T_reference"] = se3.inverse(self[reference]) @ T_map_keyframe

    def correct(
        self, version: int, T_map: Mapping[int, np.ndarray], held: Collection[int] = ()
    ) -> None:
        """Apply optimized poses of the pose graph; ignore them if the version is not newer.

        Keyframes with ids above all ids in `T_map` are newer than the correction. Their poses are
        computed again from their reference keyframes.

        Args:
            version: Version of the pose graph.
            T_map: Corrected T_map_keyframe [4, 4] by id.
            held: Keyframes whose stored pose relative to their reference keyframe is more accurate
                than the relative pose in the pose graph. The pose of such a keyframe is computed
                from the pose of its reference keyframe. If the reference keyframe is unknown, the
                pose is taken from `T_map`.
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
        """Return a view of a record, to read and write it.

        Raises:
            KeyError: The keyframe is unknown.
        """
        row = self._known.row(keyframe)
        if row is None:
            raise KeyError(keyframe)
        return self._known.all[row]

    def _placed(self, record: np.void, newest: int | None) -> np.ndarray:
        """Compute T_map_keyframe [4, 4] of a record.

        The pose is computed from the reference keyframe if that keyframe is known. Otherwise it
        comes from odometry: relative to the keyframe `newest` or, if `newest` is None, relative to
        the provisional pose of the submap.
        """
        reference = int(record["reference"])
        if reference in self:
            T_map = self[reference] @ record["T_reference"]
        elif newest is not None:
            T_map = self.T_map_odom(newest) @ record["T_odom"]
        else:
            T_map = T_map_submap(int(record["submap"])) @ record["T_odom"]
        return se3.orthonormalize(T_map)

    def _newest(self, submap: int, before: float = math.inf) -> int | None:
        """Return the newest keyframe of a submap with an id below `before`, or None."""
        records = self._known.all
        known = records["id"][(records["id"] < before) & (records["submap"] == submap)]
        return int(known[-1]) if len(known) else None

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Remove all keyframes except the given ones, to save memory."""
        self._known.keep_only(keyframes)

    def T_map_odom(self, keyframe: int) -> np.ndarray:
        """Return T_map_odom [4, 4], from the poses of a keyframe in the map and in odometry."""
        record = self._record(keyframe)
        return record["T_map"] @ se3.inverse(record["T_odom"])

    def snapshot(self) -> dict[str, Any]:
        """Return the version of the pose graph and the records of the keyframes, as arrays."""
        return {"version": self.version, **self._known.columns()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Replace the graph version and the records of the keyframes by those of a snapshot."""
        self.version = state["version"]
        self._known.restore(state)


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Relative-pose measurement between two keyframes."""

    a: int  # Keyframe that the pose is relative to.
    b: int  # Measured keyframe.
    T_a_b: np.ndarray  # [4, 4]
    # Information matrix [6, 6] of the error xi in T_a_b * exp(xi): rotation in rad, then
    # translation in m.
    information: np.ndarray
