"""Map model: arrays of Gaussians, with ids, anchor keyframes and labels.

The parameters of a Gaussian are one row of 16 float32, which fill one cache line.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import se3
from ldo_service.kernels._rasterize import Bounds

from .rows import ROW, aligned_rows, keep_rows, move_rows

# Bytes of a Gaussian's labels (`semantics.gaussian_labels`); all are 0 before any observation.
LABEL_BYTES = 32


class GaussianBatch(NamedTuple):
    """Some Gaussians of a map as arrays.

    Attributes:
        ids: [M] int64.
        rows: [M, 16] float32, see `ROW`.
        anchors: [M] int32, ids of the anchor keyframes.
        labels: [M, 32] uint8.
    """

    ids: np.ndarray
    rows: np.ndarray
    anchors: np.ndarray
    labels: np.ndarray

    def at(self, where: np.ndarray | slice) -> "GaussianBatch":
        """Return the batch of the Gaussians that an index array, a mask or a slice selects."""
        return GaussianBatch(*(array[where] for array in self))


def new_labels(n: int) -> np.ndarray:
    """Return the labels [n, 32] of n Gaussians whose class has never been observed."""
    return np.zeros((n, LABEL_BYTES), np.uint8)


class GaussianMap:
    """Gaussians in memory, in the map frame and in the order of their ids.

    `rows`, its columns (`means`, ...), `ids`, `anchors` and `labels` are NumPy views, valid until
    Gaussians are added or removed. After writing through one of them, call `touch` before the next
    rendering. A Gaussian takes 108 bytes, 32 of them for its labels.

    Attributes:
        version: Counter that increases with every change, except for changes of labels, which do
            not affect renderings.
        membership: Counter that increases when Gaussians may have been added or removed.
        bounds: Bounding volumes of the rows. `render` uses them to read only visible rows.
    """

    def __init__(self, capacity: int = 4096) -> None:
        self._rows = aligned_rows(capacity)
        self._ids = np.zeros(capacity, np.int64)
        self._anchors = np.zeros(capacity, np.int32)
        self._labels = new_labels(capacity)
        self._size = 0
        self._next_id = 0
        self.version = 0
        self.membership = 0
        self.bounds = Bounds()

    def __len__(self) -> int:
        return self._size

    @property
    def rows(self) -> np.ndarray:
        """Parameters of all Gaussians, [N, 16] float32; see `render` for the columns."""
        return self._rows[: self._size]

    @property
    def means(self) -> np.ndarray:
        """Means in the map frame, [N, 3], meters."""
        return self.rows[:, 0:3]

    @property
    def log_scales(self) -> np.ndarray:
        """Logarithms of the standard deviations in meters, [N, 3]."""
        return self.rows[:, 3:6]

    @property
    def quats(self) -> np.ndarray:
        """Rotations from the principal axes of each Gaussian to the map frame, [N, 4] wxyz."""
        return self.rows[:, 6:10]

    @property
    def opacity_logits(self) -> np.ndarray:
        """Logits of the opacities, [N]."""
        return self.rows[:, 10]

    @property
    def colors(self) -> np.ndarray:
        """RGB colors in 0..1, [N, 3]."""
        return self.rows[:, 11:14]

    @property
    def ids(self) -> np.ndarray:
        """Ids, [N] int64, ascending and never reused."""
        return self._ids[: self._size]

    @property
    def anchors(self) -> np.ndarray:
        """Id of each Gaussian's anchor keyframe, with which it moves, [N] int32."""
        return self._anchors[: self._size]

    @property
    def labels(self) -> np.ndarray:
        """Label distributions, [N, 32] uint8; see `semantics.gaussian_labels`."""
        return self._labels[: self._size]

    @property
    def next_id(self) -> int:
        """Id of the next new Gaussian."""
        return self._next_id

    @property
    def _arrays(self) -> GaussianBatch:
        """Allocated arrays of all fields, which are longer than the N Gaussians in use."""
        return GaussianBatch(self._ids, self._rows, self._anchors, self._labels)

    def touch(self, rows: np.ndarray | slice | None = None) -> None:
        """Record that rows of the map were written through one of its array views.

        Args:
            rows: The rows that were written: indices [M] uint32, or a slice without a step. None
                means all rows.
        """
        self.version += 1
        if rows is None:
            self.membership += 1
            self.bounds.forget()
        elif isinstance(rows, slice):
            first, last, _ = rows.indices(self._size)
            self.bounds.forget(first, max(first, last))
        else:
            self.bounds.forget_rows(rows)

    def add(self, rows: np.ndarray, anchor: int) -> np.ndarray:
        """Append Gaussians.

        Args:
            rows: Parameters, [M, 16], with the columns of the property `rows`.
            anchor: Id of the anchor keyframe of the new Gaussians.

        Returns:
            Ids [M] of the new Gaussians.

        Raises:
            ValueError: The rows have another shape, or hold NaN or infinity.
        """
        ids = np.arange(self._next_id, self._next_id + len(rows))
        self.append(ids, rows, np.full(len(rows), anchor, np.int32))
        return ids

    def append(
        self,
        ids: np.ndarray,
        rows: np.ndarray,
        anchors: np.ndarray,
        labels: np.ndarray | None = None,
    ) -> None:
        """Append Gaussians with given ids, as a replica of another map does.

        Args:
            ids: [M], ascending and greater than all ids that this map ever had.
            rows: Parameters, [M, 16], with the columns of the property `rows`.
            anchors: Ids of the anchor keyframes, [M].
            labels: [M, 32]; None for Gaussians without observations.

        Raises:
            ValueError: An array has another shape, the ids do not ascend, or the rows hold NaN or
                infinity.
        """
        new = _piece(ids, rows, anchors, labels)
        if len(ids) and (ids[0] < self._next_id or np.any(np.diff(ids) <= 0)):
            raise ValueError(
                f"ids must ascend, and the first id must be at least {self._next_id}, the next "
                f"unused id of this map. The first id is {ids[0]}."
            )
        start, stop = self._size, self._size + len(rows)
        self._reserve(stop)
        for array, values in zip(self._arrays, new, strict=True):
            array[start:stop] = values
        self._size = stop
        self._next_id = int(ids[-1]) + 1 if len(ids) else self._next_id
        self.membership += 1
        self.touch(slice(start, stop))

    def remove(self, mask: np.ndarray) -> int:
        """Remove the Gaussians where mask [N] is true; the others keep their order and ids.

        Returns:
            Number of removed Gaussians.

        Raises:
            ValueError: The mask has another size or type.
        """
        self._require_mask(mask)
        if not np.any(mask):
            return 0
        first = int(np.argmax(mask))  # Earlier rows stay in place.
        kept = first + np.flatnonzero(~mask[first:])
        size = first + len(kept)
        for array in self._arrays:
            keep_rows(array, first, kept)
        self.touch(slice(first, None))
        removed, self._size = self._size - size, size
        self.membership += 1
        return removed

    def all(self) -> GaussianBatch:
        """Return all Gaussians without a copy."""
        return GaussianBatch(self.ids, self.rows, self.anchors, self.labels)

    def extract(self, mask: np.ndarray) -> GaussianBatch:
        """Remove the Gaussians where mask [N] is true and return copies of them.

        Raises:
            ValueError: The mask has another size or type.
        """
        self._require_mask(mask)
        taken = self.all().at(mask)
        self.remove(mask)
        return taken

    def reinsert(
        self,
        ids: np.ndarray,
        rows: np.ndarray,
        anchors: np.ndarray,
        labels: np.ndarray | None = None,
    ) -> None:
        """Insert Gaussians that were extracted from this map, at their places in the order of ids.

        The computing time is linear in the size N of the map.

        Args:
            ids: [M], in any order. This map assigned them earlier, and they are absent now.
            rows: Parameters, [M, 16], with the columns of the property `rows`.
            anchors: Ids of the anchor keyframes, [M].
            labels: [M, 32]; None for Gaussians without observations.

        Raises:
            ValueError: An array has another shape, the rows hold NaN or infinity, or an id is
                invalid: it is in the map already, is given twice, or was never assigned by this
                map.
        """
        returned = _piece(ids, rows, anchors, labels).at(np.argsort(ids, kind="stable"))
        # Number of rows of the map before each of these Gaussians.
        before = np.searchsorted(self.ids, returned.ids)
        self._require_absent(returned.ids, before)
        if len(ids) == 0:
            return
        places, old_size = before + np.arange(len(ids)), self._size
        self._reserve(old_size + len(ids))
        self._size = old_size + len(ids)
        first = int(places[0])
        stay = np.ones(self._size - first, bool)
        stay[places - first] = False
        for array, values in zip(self._arrays, returned, strict=True):
            array[first : self._size][stay] = array[first:old_size].copy()
            array[places] = values
        self.touch()
        self.membership += 1

    def move_anchors(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Move the Gaussians of some anchor keyframes: mean <- T mean, quat <- q(T) quat.

        The quaternion q(T) is the rotation of T. The computing time is linear in the size N of the
        map.

        Args:
            T_new_old: Motions T [4, 4] in the map frame, by id of the anchor keyframe. Each is
                T_map_keyframe(new) @ inverse(T_map_keyframe(old)). Gaussians of other anchor
                keyframes do not move.

        Raises:
            ValueError: A transform is not [4, 4] and finite.
        """
        keyframes = np.array(sorted(T_new_old), np.int64)
        if len(keyframes) == 0 or self._size == 0:
            return
        T = np.stack([np.asarray(T_new_old[int(k)], float) for k in keyframes])
        if T.shape[1:] != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(
                "each transform in T_new_old must be finite with shape [4, 4]; at least one is not."
            )
        q = se3.quaternion(T[:, :3, :3])
        move_rows(self._rows[: self._size], self._anchors[: self._size], keyframes, T, q)
        self.touch()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return a copy of the state as named arrays."""
        return {
            "rows": self.rows.copy(),
            "ids": self.ids.copy(),
            "anchors": self.anchors.copy(),
            "labels": self.labels.copy(),
            "next_id": np.array(self._next_id, np.int64),
            "version": np.array(self.version, np.int64),
        }

    @classmethod
    def restore(cls, state: Mapping[str, np.ndarray]) -> "GaussianMap":
        """Return the map that a snapshot contains; it is bitwise equal to the saved map.

        Raises:
            DataError: The snapshot has no labels, because an earlier version saved it.
        """
        if "labels" not in state:
            raise DataError(
                "the saved state has no labels of Gaussians: an earlier version saved it. "
                "Start with another state folder."
            )
        size = len(state["rows"])
        out = cls(max(size, 1))
        for name, array in out._arrays._asdict().items():
            array[:size] = state[name]
        out._size, out._next_id = size, int(state["next_id"])
        out.version = int(state["version"])
        return out

    def _require_mask(self, mask: np.ndarray) -> None:
        if mask.shape != (self._size,) or mask.dtype != np.bool_:
            raise ValueError(f"mask is {mask.dtype}{mask.shape}; it must be bool({self._size},).")

    def _require_absent(self, ids: np.ndarray, before: np.ndarray) -> None:
        if np.any(np.diff(ids) <= 0):
            raise ValueError("each id may be given only once; at least one is given twice.")
        if len(ids) and not (ids[0] >= 0 and ids[-1] < self._next_id):
            raise ValueError(
                f"the given ids are {ids[0]} to {ids[-1]}. All must be ids of this map, 0 to "
                f"{self._next_id - 1}."
            )
        inside = before < self._size
        present = self.ids[before[inside]] == ids[inside]
        if np.any(present):
            raise ValueError(
                f"id {ids[inside][present][0]} is in the map already. Reinsert only absent ids."
            )

    def _reserve(self, size: int) -> None:
        if size <= len(self._rows):
            return
        capacity = max(size, 2 * len(self._rows))
        grown = GaussianMap(capacity)._arrays
        for new, old in zip(grown, self._arrays, strict=True):
            new[: self._size] = old[: self._size]
        self._ids, self._rows, self._anchors, self._labels = grown


def _piece(
    ids: np.ndarray, rows: np.ndarray, anchors: np.ndarray, labels: np.ndarray | None
) -> GaussianBatch:
    if rows.ndim != 2 or rows.shape[1] != ROW or not len(ids) == len(anchors) == len(rows):
        raise ValueError(
            f"rows must have shape [M, {ROW}], with M ids and M anchors. They have shape "
            f"{rows.shape}, with {len(ids)} ids and {len(anchors)} anchors."
        )
    if not np.all(np.isfinite(rows)):
        raise ValueError("rows must be finite, but contain NaN or infinity.")
    labels = new_labels(len(ids)) if labels is None else labels
    if labels.shape != (len(ids), LABEL_BYTES) or labels.dtype != np.uint8:
        raise ValueError(
            f"labels are {labels.dtype}{labels.shape}; they must be uint8[M, 32] for M ids."
        )
    return GaussianBatch(ids, rows, anchors, labels)
