"""Where keyframes are in the map, as one receiver knows it. Conventions: `ldo_service.geometry`."""

from collections.abc import Iterable, Iterator

import numpy as np

from . import se3


class KeyframePoses:
    """T_map_keyframe by id, chained from relative measurements and replaced by corrections.

    Every receiver of keyframes keeps one. Two receivers that know the same correction and chained
    the same keyframes agree, whatever the order in which the two arrived.
    Grows by two 4x4 matrices a keyframe: 0.3 MB an hour at a keyframe a second.
    """

    def __init__(self) -> None:
        self.version = 0  # of the last correction
        self._T_map: dict[int, np.ndarray] = {}
        self._T_odom: dict[int, np.ndarray] = {}

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
    ) -> np.ndarray:
        """Place a new keyframe; its T_map_keyframe.

        A reference that is not known was missed: odometry to the newest known one stands in.
        """
        if reference in self._T_map and reference is not None:
            T_map = self._T_map[reference] @ T_reference_keyframe
        elif self._T_map:
            newest = max(self._T_map)
            T_map = self._T_map[newest] @ se3.inverse(self._T_odom[newest]) @ T_odom_keyframe
        else:
            T_map = np.array(T_odom_keyframe, float)
        self._T_map[keyframe] = se3.orthonormalised(T_map)
        self._T_odom[keyframe] = np.array(T_odom_keyframe, float)
        return self._T_map[keyframe]

    def correct(self, version: int, T_map: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Take over a correction; T_new_old of every known keyframe.

        Keyframes made after it move with the newest one that it names, those it does not know and
        that are older stay. An older correction than the last changes nothing.
        """
        if version <= self.version or not T_map:
            return {}
        self.version = version
        newest = max(T_map)
        follow = T_map[newest] @ se3.inverse(self._T_map[newest]) if newest in self else None
        motions: dict[int, np.ndarray] = {}
        for keyframe, T_old in self._T_map.items():
            T_new = T_map.get(keyframe)
            if T_new is None and keyframe > newest and follow is not None:
                T_new = se3.orthonormalised(follow @ T_old)
            if T_new is not None:
                motions[keyframe] = T_new @ se3.inverse(T_old)
                self._T_map[keyframe] = T_new
        return motions

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Forget all others, for a receiver that needs a few."""
        kept = [k for k in keyframes if k in self._T_map]
        self._T_map = {k: self._T_map[k] for k in kept}
        self._T_odom = {k: self._T_odom[k] for k in kept}

    def T_map_odom(self, keyframe: int) -> np.ndarray:
        """The odometry frame in the map [4, 4], as seen at a keyframe."""
        return self._T_map[keyframe] @ se3.inverse(self._T_odom[keyframe])

    def snapshot(self) -> dict[str, object]:
        ids = list(self._T_map)
        return {
            "version": self.version,
            "keyframes": np.array(ids, np.int64),
            "T_map": np.array([self._T_map[k] for k in ids]).reshape(-1, 4, 4),
            "T_odom": np.array([self._T_odom[k] for k in ids]).reshape(-1, 4, 4),
        }

    def restore(self, state: dict[str, object]) -> None:
        self.version = int(state["version"])  # type: ignore[call-overload]
        ids = [int(k) for k in state["keyframes"]]  # type: ignore[union-attr, attr-defined]
        self._T_map = dict(zip(ids, np.asarray(state["T_map"]), strict=True))
        self._T_odom = dict(zip(ids, np.asarray(state["T_odom"]), strict=True))
