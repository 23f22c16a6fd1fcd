"""Copy of a map in GPU memory: rows, Adam moments and step counts, in the order of the map."""

from typing import Any
from weakref import ref

import numpy as np

from ldo_service.errors import DeviceError
from ldo_service.kernels.gpu.arrays import Arrays

from .adam import Adam, places_of_remaining
from .model import GaussianMap
from .renderer import AdamStep
from .rows import ROW


class GaussianMirror:
    """Copy of the rows, Adam moments and step counts of a map in GPU memory.

    A Gaussian takes 196 bytes. When the mirror must grow, its capacity at least doubles, so that a
    Gaussian takes up to 392 bytes. The mirror copies its arrays one by one when it grows, and when
    Gaussians get new indices. The copy takes up to 192 bytes more per Gaussian.

    The map and its `Adam` stay on the CPU. `update` uploads what changed on the CPU since the last
    call, and `write_back` downloads what changed on the GPU. Between the two calls, the map must
    not change.

    Attributes:
        rows: Gaussians, [capacity, 16] float32.
        moments: First moments, [capacity, 16] float32.
        squares: Second moments, [capacity, 16] float32.
        steps: Number of steps of each row, [capacity] int32.
        uploaded: Number of rows that the last `update` uploaded.
        downloaded: Number of rows that the last `write_back` downloaded.
    """

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self._map: ref[GaussianMap] | None = None
        self._matches = self._restores = 0
        self._ids = np.zeros(0, np.int64)
        self._known = np.zeros((0, ROW), np.float32)  # Rows on the device.
        self._capacity = 0
        self.rows, self.moments, self.squares, self.steps = self._zeros(0)
        self.uploaded = self.downloaded = 0

    def update(self, gaussians: GaussianMap, adam: Adam) -> None:
        """Upload all rows that changed in the map, and apply its additions and removals.

        The moments are uploaded too if, since the last call, `adam` was restored or has adapted its
        moments to additions or removals more than once. The mirror cannot follow such changes.
        """
        state = adam.arguments(gaussians)
        is_known = self._map is not None and self._map() is gaussians
        if is_known and adam.restores == self._restores and adam.matches - self._matches <= 1:
            self._follow(gaussians.ids)
        else:
            self._replace(gaussians, state)
        self._map = ref(gaussians)
        self._matches, self._restores = adam.matches, adam.restores
        self._ids = gaussians.ids.copy()
        is_changed = (self._known.view(np.int32) != gaussians.rows.view(np.int32)).any(axis=1)
        changed = np.flatnonzero(is_changed)
        self.uploaded = len(changed)
        if len(changed):
            self._known[changed] = gaussians.rows[changed]
            self._put(self.rows, changed, gaussians.rows[changed])

    def write_back(self, gaussians: GaussianMap, adam: Adam) -> None:
        """Download the rows, Adam moments and step counts that changed on the GPU.

        Raises:
            DeviceError: A downloaded value is NaN or infinite. The map is unchanged.
        """
        state = adam.arguments(gaussians)
        n = len(gaussians)
        steps = self._arrays.download(self.steps)[:n]
        touched = np.flatnonzero(steps != state.steps)
        self.downloaded = len(touched)
        if len(touched) == 0:
            return
        places = self._arrays.upload(touched.astype(np.int32))
        rows, moments, squares = (
            self._arrays.download(self._arrays.take(array, places))
            for array in (self.rows, self.moments, self.squares)
        )
        # The map changes only after the last check, so that a failed device leaves it as it was.
        for name, values in (("rows", rows), ("moments", moments), ("squared moments", squares)):
            if not np.isfinite(values).all():
                raise DeviceError(
                    f"the GPU computed NaN or infinity in the {name} of the map. If this happens "
                    "again, set service.device=cpu."
                )
        gaussians.rows[touched] = self._known[touched] = rows
        state.mean[touched], state.square[touched] = moments, squares
        state.steps[touched] = steps[touched]
        gaussians.touch(touched.astype(np.uint32))

    def _zeros(self, capacity: int) -> tuple[Any, Any, Any, Any]:
        rows, moments, squares = (self._arrays.zeros((capacity, ROW), np.float32) for _ in range(3))
        return rows, moments, squares, self._arrays.zeros((capacity,), np.int32)

    def _put(self, array: Any, places: np.ndarray, values: np.ndarray) -> None:
        on_device = self._arrays.upload(places.astype(np.int32))
        self._arrays.put(array, on_device, self._arrays.upload(values))

    def _follow(self, ids: np.ndarray) -> None:
        """Move rows and state of the remaining Gaussians to their new places.

        The state of all other places becomes zero, as in `Adam`. Additions at the end of the map
        move nothing while the capacity suffices.
        """
        n = len(self._ids)
        is_extended = np.array_equal(ids[:n], self._ids)
        if is_extended and len(ids) <= self._capacity:
            if len(ids) > n:
                added = np.zeros((len(ids) - n, ROW), np.float32)
                self._known = np.concatenate([self._known, added])
            return
        old_places, places = places_of_remaining(self._ids, ids)
        if len(ids) > self._capacity:
            self._capacity = max(len(ids), 2 * self._capacity)
        kept, moved_to = (self._arrays.upload(x.astype(np.int32)) for x in (old_places, places))

        def moved(old: Any, shape: tuple[int, ...], dtype: type) -> Any:
            new = self._arrays.zeros((self._capacity, *shape), dtype)
            self._arrays.put(new, moved_to, self._arrays.take(old, kept))
            return new

        # The arrays are moved one after the other, so that only one of them exists twice.
        self.rows = moved(self.rows, (ROW,), np.float32)
        self.moments = moved(self.moments, (ROW,), np.float32)
        self.squares = moved(self.squares, (ROW,), np.float32)
        self.steps = moved(self.steps, (), np.int32)
        known = np.zeros((len(ids), ROW), np.float32)
        known[places] = self._known[old_places]
        self._known = known

    def _replace(self, gaussians: GaussianMap, state: AdamStep) -> None:
        """Upload moments and step counts of all Gaussians; `update` then uploads their rows."""
        n = len(gaussians)
        self._capacity = n
        self.rows = self._arrays.zeros((n, ROW), np.float32)
        self._known = np.zeros((n, ROW), np.float32)
        self.moments, self.squares, self.steps = (
            self._arrays.upload(x) for x in (state.mean, state.square, state.steps)
        )
