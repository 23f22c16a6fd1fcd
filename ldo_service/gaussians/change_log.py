"""What of a map its followers do not know yet."""

from dataclasses import dataclass

import numpy as np

from .model import GaussianMap


@dataclass(frozen=True, eq=False, slots=True)
class Changes:
    """removed  [R] int64, ids, ascending
    changed  [C] rows of the map whose parameters are other than was told
    added    [A] rows of the map that were never told of
    """

    removed: np.ndarray
    changed: np.ndarray
    added: np.ndarray


class ChangeLog:
    """Beside a map: who changes the map says so here.

    Followers get new Gaussians at once and the parameters of old ones now and then, because the
    optimiser touches most of what is in view at every keyframe. Motions by anchor are theirs to
    apply: they change no row here.
    """

    def __init__(self) -> None:
        self._next_untold = 0  # ids from here on were never told
        self._is_changed = np.zeros(0, bool)  # per row of the map, as it was last seen
        self._removed: list[np.ndarray] = []

    def mark_added(self, gaussians: GaussianMap) -> None:
        """Rows were appended."""
        new = len(gaussians) - len(self._is_changed)
        self._is_changed = np.concatenate([self._is_changed, np.zeros(new, bool)])

    def changed(self, mask: np.ndarray) -> None:
        """The rows where `mask` [N] is true were written to."""
        self._is_changed |= mask

    def mark_removed(self, gaussians: GaussianMap, mask: np.ndarray) -> None:
        """The rows where `mask` [N] is true are about to go."""
        ids = gaussians.ids[mask]
        self._removed.append(ids[ids < self._next_untold])
        self._is_changed = self._is_changed[~mask]

    def lost(self, ids: np.ndarray) -> None:
        """These [L] are gone for good, from where nobody looked."""
        self._removed.append(ids[ids < self._next_untold])

    def mark_loaded(self, gaussians: GaussianMap, ids: np.ndarray) -> None:
        """Rows came back as followers hold them."""
        is_changed = np.zeros(len(gaussians), bool)
        is_changed[~np.isin(gaussians.ids, ids, assume_unique=True)] = self._is_changed
        self._is_changed = is_changed

    def drain(self, gaussians: GaussianMap, *, with_changed: bool) -> Changes:
        """What is to be told now; it counts as told. Without `with_changed` the rows that changed
        wait for another time."""
        first_new = int(np.searchsorted(gaussians.ids, self._next_untold))
        changed = np.zeros(0, np.int64)
        if with_changed:
            changed = np.flatnonzero(self._is_changed[:first_new])
            self._is_changed[:] = False
        self._is_changed[first_new:] = False  # told with what they are now
        removed = np.sort(np.concatenate([np.zeros(0, np.int64), *self._removed]))
        self._removed.clear()
        if len(gaussians) > first_new:
            self._next_untold = int(gaussians.ids[-1]) + 1
        return Changes(removed, changed, np.arange(first_new, len(gaussians)))

    def mark_all_published(self, gaussians: GaussianMap) -> None:
        """Followers know the whole map, which may be another than it was."""
        newest = int(gaussians.ids[-1]) if len(gaussians) else -1
        self._next_untold = max(self._next_untold, newest + 1)
        self._is_changed = np.zeros(len(gaussians), bool)
        self._removed.clear()
