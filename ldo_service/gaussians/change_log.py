"""Records of changed Gaussians and keyframe poses that were not sent to map replicas yet."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.point_records import PoseTable

from .model import GaussianMap


@dataclass(frozen=True, eq=False, slots=True)
class Changes:
    """Changes of the map that `ChangeLog.drain` returns for publication.

    Attributes:
        removed: Ids of removed Gaussians, [R] int64, ascending.
        changed: Row indices of published Gaussians whose parameters or labels have changed, [C]
            int64. Empty if `drain` was called with `with_changed=False`.
        added: Row indices of Gaussians that were never published, [A] int64.
    """

    removed: np.ndarray
    changed: np.ndarray
    added: np.ndarray


class ChangeLog:
    """Unpublished changes of a map. The caller must record every change of the map here.

    New Gaussians are published with the next update. Changed parameters of published Gaussians are
    published less often, because the Gaussian optimizer changes most visible Gaussians at every
    keyframe. Motions of anchor keyframes are not recorded, because each map replica applies them to
    its own Gaussians.
    """

    def __init__(self) -> None:
        self._next_untold = 0  # Smallest id that was never published.
        self._is_changed = np.zeros(0, bool)  # One value per row of the map.
        self._removed: list[np.ndarray] = []

    def mark_added(self, gaussians: GaussianMap) -> None:
        """Record that new Gaussians were appended to the map."""
        new = len(gaussians) - len(self._is_changed)
        self._is_changed = np.concatenate([self._is_changed, np.zeros(new, bool)])

    def changed(self, mask: np.ndarray) -> None:
        """Record that Gaussians have changed: those at the rows where `mask` [N] is true."""
        self._is_changed |= mask

    def mark_removed(self, gaussians: GaussianMap, mask: np.ndarray) -> None:
        """Record that Gaussians are about to be removed: the rows where `mask` [N] is true."""
        ids = gaussians.ids[mask]
        self._removed.append(ids[ids < self._next_untold])
        self._is_changed = self._is_changed[~mask]

    def lost(self, ids: np.ndarray) -> None:
        """Record that offloaded Gaussians with these ids [L] cannot be loaded any more."""
        self._removed.append(ids[ids < self._next_untold])

    def mark_loaded(self, gaussians: GaussianMap, ids: np.ndarray) -> None:
        """Record that offloaded Gaussians were loaded; they count as unchanged.

        Args:
            gaussians: The map, with the loaded Gaussians.
            ids: Ids of the loaded Gaussians, [M].
        """
        is_changed = np.zeros(len(gaussians), bool)
        is_changed[~np.isin(gaussians.ids, ids, assume_unique=True)] = self._is_changed
        self._is_changed = is_changed

    def drain(self, gaussians: GaussianMap, *, with_changed: bool) -> Changes:
        """Return the changes to publish now and mark them as published.

        Args:
            gaussians: The map.
            with_changed: Include changed rows. If False, a later call returns them.
        """
        first_new = int(np.searchsorted(gaussians.ids, self._next_untold))
        changed = np.zeros(0, np.int64)
        if with_changed:
            changed = np.flatnonzero(self._is_changed[:first_new])
            self._is_changed[:] = False
        self._is_changed[first_new:] = False  # Added rows are published with their current values.
        removed = np.sort(np.concatenate([np.zeros(0, np.int64), *self._removed]))
        self._removed.clear()
        if len(gaussians) > first_new:
            self._next_untold = int(gaussians.ids[-1]) + 1
        return Changes(removed, changed, np.arange(first_new, len(gaussians)))

    def mark_all_published(self, gaussians: GaussianMap) -> None:
        """Drop all records, so that the whole map counts as published.

        The caller does this after it restored the map.
        """
        newest = int(gaussians.ids[-1]) if len(gaussians) else -1
        self._next_untold = max(self._next_untold, newest + 1)
        self._is_changed = np.zeros(len(gaussians), bool)
        self._removed.clear()


class PublishedPoses:
    """Last published poses T_map_keyframe of the keyframes whose images are stored.

    Args:
        min_m: A pose is published again if it has moved by more than this distance since its last
            publication, meters.
        min_rad: A pose is also published again after a rotation by more than this angle, radians.
    """

    def __init__(self, min_m: float, min_rad: float) -> None:
        self._poses = PoseTable()
        self._min_m, self._min_rad = min_m, min_rad

    def add(self, keyframe: int, T_map_keyframe: np.ndarray) -> None:
        """Record that the pose [4, 4] of a new keyframe is published together with the keyframe."""
        self._poses[keyframe] = T_map_keyframe

    def forget(self, keyframe: int) -> None:
        """Drop a keyframe whose images are no longer stored."""
        del self._poses[keyframe]

    def drain(self, poses: PoseTable) -> dict[int, np.ndarray]:
        """Return the poses to publish now, by keyframe id, and mark them as published.

        Args:
            poses: Current poses T_map_keyframe of all keyframes.
        """
        known = self._poses
        is_news = se3.transforms_differ(
            poses.of(known), known.of(known), self._min_m, self._min_rad
        )
        moved = {k: poses[k] for k, is_new in zip(known, is_news, strict=True) if is_new}
        known.update(moved)
        return moved

    def move(self, T_map: Mapping[int, np.ndarray]) -> None:
        """Record corrected poses as published, so that `drain` does not return them.

        Args:
            T_map: Poses T_map_keyframe [4, 4] after a correction of the pose graph, by keyframe id.
        """
        self._poses.update({k: T for k, T in T_map.items() if k in self._poses})

    def snapshot(self) -> np.ndarray:
        """Return the last published poses [K, 4, 4] in the order of the keyframe ids."""
        return self._poses.of(self._poses)

    def restore(self, keyframes: Collection[int], T_map: np.ndarray) -> None:
        """Replace all poses by those of a snapshot: `T_map` [K, 4, 4] of the K `keyframes`."""
        self._poses.become(keyframes, T_map)
