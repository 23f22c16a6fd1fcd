"""The map: Gaussians in rows of one cache line, with stable ids, the keyframes they hang on, and
what they have been seen as."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import se3
from ldo_service.kernels._rasterize import Bounds

ROW = 16  # floats: mean 3, log scale 3, quaternion wxyz 4, opacity logit, rgb 3, 2 unused
LABEL_BYTES = 32  # per Gaussian; what they mean: `semantics.labels`. Zeros: nobody has seen it
_CHUNK = 65536  # Gaussians that are moved at a time, to stay in cache


class GaussianBatch(NamedTuple):
    """Some Gaussians of a map, in order.

    ids     [M] int64
    rows    [M, 16] float32
    anchors [M] int32
    labels  [M, 32] uint8
    """

    ids: np.ndarray
    rows: np.ndarray
    anchors: np.ndarray
    labels: np.ndarray

    def at(self, where: np.ndarray | slice) -> "GaussianBatch":
        return GaussianBatch(*(array[where] for array in self))


def new_labels(n: int) -> np.ndarray:
    """Labels [n, 32] of Gaussians that nobody has seen."""
    return np.zeros((n, LABEL_BYTES), np.uint8)


class GaussianMap:
    """Gaussians in the map frame, in order of insertion.

    `rows`, its columns (`means`, ...), `ids`, `anchors` and `labels` are views without a copy,
    valid until Gaussians come or go. Who writes through `rows` calls `touch` before the next
    rendering. `version` grows with every change but those of labels, which no rendering shows;
    `membership` when Gaussians may have come or gone. `bounds` says to `render` where the rows lie,
    so that it reads those in view only. A Gaussian takes 108 bytes, 32 of them its labels.
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
        """[N, 16] float32, as `render` takes them."""
        return self._rows[: self._size]

    @property
    def means(self) -> np.ndarray:
        """[N, 3] metres, map frame."""
        return self.rows[:, 0:3]

    @property
    def log_scales(self) -> np.ndarray:
        """[N, 3] log of the standard deviations in metres."""
        return self.rows[:, 3:6]

    @property
    def quats(self) -> np.ndarray:
        """[N, 4] wxyz, rotate the Gaussians' axes to the map frame."""
        return self.rows[:, 6:10]

    @property
    def opacity_logits(self) -> np.ndarray:
        """[N]"""
        return self.rows[:, 10]

    @property
    def colors(self) -> np.ndarray:
        """[N, 3] RGB, 0..1."""
        return self.rows[:, 11:14]

    @property
    def ids(self) -> np.ndarray:
        """[N] int64, ascending, never used twice."""
        return self._ids[: self._size]

    @property
    def anchors(self) -> np.ndarray:
        """[N] int32, id of the keyframe that each Gaussian moves with."""
        return self._anchors[: self._size]

    @property
    def labels(self) -> np.ndarray:
        """[N, 32] uint8, what each has been seen as: see `semantics.labels`."""
        return self._labels[: self._size]

    @property
    def _arrays(self) -> GaussianBatch:
        """With the room behind the last Gaussian."""
        return GaussianBatch(self._ids, self._rows, self._anchors, self._labels)

    def touch(self, rows: np.ndarray | slice | None = None) -> None:
        """Say what was written through a view: the rows with these numbers (uint32, or a slice
        without a step). Without an argument anything may have changed, which is always safe."""
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
        """Append rows [M, 16] that hang on keyframe `anchor`; returns their ids [M].

        Raises ValueError for another shape, and for NaN or infinity.
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
        """Append Gaussians that another map gave their ids [M], above all in this one, to follow
        it. Without labels [M, 32] nobody has seen them.

        Raises ValueError for other shapes, ids that do not ascend, NaN and infinity.
        """
        new = _piece(ids, rows, anchors, labels)
        if len(ids) and (ids[0] < self._next_id or np.any(np.diff(ids) <= 0)):
            raise ValueError(f"ids must ascend from {self._next_id}.")
        start, stop = self._size, self._size + len(rows)
        self._reserve(stop)
        for array, values in zip(self._arrays, new, strict=True):
            array[start:stop] = values
        self._size = stop
        self._next_id = int(ids[-1]) + 1 if len(ids) else self._next_id
        self.membership += 1
        self.touch(slice(start, stop))

    def remove(self, mask: np.ndarray) -> int:
        """Drop the Gaussians where mask [N] is true; the others keep their order and ids.

        Returns how many went. Raises ValueError for a mask of another size or type.
        """
        self._require_mask(mask)
        if not np.any(mask):
            return 0
        first = int(np.argmax(mask))  # what comes before stays in place
        keep = ~mask[first:]
        size = first + int(np.count_nonzero(keep))
        for array in self._arrays:
            array[first:size] = array[first : self._size][keep]
        self.touch(slice(first, None))
        removed, self._size = self._size - size, size
        self.membership += 1
        return removed

    def all(self) -> GaussianBatch:
        """All of them, without a copy."""
        return GaussianBatch(self.ids, self.rows, self.anchors, self.labels)

    def extract(self, mask: np.ndarray) -> GaussianBatch:
        """Remove the Gaussians where mask [N] is true, to keep them elsewhere for a while.

        Returns copies. Raises ValueError as `remove`.
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
        """Put Gaussians that this map gave their ids [M], and that are absent now, where they
        were among the others: `ids` ascend again. They may come in any order; without labels
        [M, 32] nobody has seen them.

        Raises ValueError for other shapes, NaN and infinity, an id that is present, given twice
        or never was this map's. Linear in N.
        """
        returned = _piece(ids, rows, anchors, labels).at(np.argsort(ids, kind="stable"))
        before = np.searchsorted(self.ids, returned.ids)  # how many of those here come before each
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
        """Move what hangs on each keyframe: mean <- T mean, quat <- q(T) quat.

        T_new_old  per keyframe id the transform [4, 4] from the old place in the map to the new
                   one, T_map_keyframe(new) @ inverse(T_map_keyframe(old)); others stay.
        Raises ValueError for a transform that is not finite. Linear in N, computed in float64.
        """
        keyframes = np.array(sorted(T_new_old), np.int64)
        if len(keyframes) == 0 or self._size == 0:
            return
        T = np.stack([np.asarray(T_new_old[int(k)], float) for k in keyframes])
        if T.shape[1:] != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError("transforms must be [4, 4] and finite.")
        q = se3.quaternion(T[:, :3, :3])
        for start in range(0, self._size, _CHUNK):
            chunk = slice(start, min(start + _CHUNK, self._size))
            _move(self._rows[chunk], self._anchors[chunk], keyframes, T, q)
        self.touch()

    def snapshot(self) -> dict[str, np.ndarray]:
        """A copy of everything, as named arrays."""
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
        """The map of which `state` is the snapshot, exactly. Raises DataError for one without
        labels."""
        if "labels" not in state:
            raise DataError(
                "the state has no labels of Gaussians: an earlier version saved it. Start with "
                "another folder for states."
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
            raise ValueError(f"mask is {mask.dtype}{mask.shape}, must be bool({self._size},).")

    def _require_absent(self, ids: np.ndarray, before: np.ndarray) -> None:
        if np.any(np.diff(ids) <= 0):
            raise ValueError("an id comes back twice.")
        if len(ids) and not (ids[0] >= 0 and ids[-1] < self._next_id):
            raise ValueError(f"ids {ids[0]} to {ids[-1]}: this map gave 0 to {self._next_id - 1}.")
        inside = before < self._size
        present = self.ids[before[inside]] == ids[inside]
        if np.any(present):
            raise ValueError(f"id {ids[inside][present][0]} is in the map already.")

    def _reserve(self, size: int) -> None:
        if size <= len(self._rows):
            return
        capacity = max(size, 2 * len(self._rows))
        grown = GaussianMap(capacity)._arrays
        for new, old in zip(grown, self._arrays, strict=True):
            new[: self._size] = old[: self._size]
        self._ids, self._rows, self._anchors, self._labels = grown


def aligned_rows(capacity: int) -> np.ndarray:
    """Zeroed rows [capacity, 16], each of which fills one 64-byte cache line."""
    memory = np.zeros(capacity * ROW + 16, np.float32)
    skip = (-memory.ctypes.data % 64) // 4
    return memory[skip : skip + capacity * ROW].reshape(capacity, ROW)


def transform_rows(rows: np.ndarray, T_new_old: np.ndarray) -> np.ndarray:
    """Copies of rows [M, 16] moved by T_new_old [4, 4], as `move_anchors` moves them."""
    out = aligned_rows(len(rows))
    out[:] = rows
    T = np.asarray(T_new_old, float)[None]
    q = se3.quaternion(T[:, :3, :3])
    _move(out, np.zeros(len(rows), np.int32), np.zeros(1, np.int64), T, q)
    return out


def _piece(
    ids: np.ndarray, rows: np.ndarray, anchors: np.ndarray, labels: np.ndarray | None
) -> GaussianBatch:
    if rows.ndim != 2 or rows.shape[1] != ROW or not len(ids) == len(anchors) == len(rows):
        raise ValueError(f"rows have shape {rows.shape}, must be [M, {ROW}], with M ids.")
    if not np.all(np.isfinite(rows)):
        raise ValueError("rows hold NaN or infinity.")
    labels = new_labels(len(ids)) if labels is None else labels
    if labels.shape != (len(ids), LABEL_BYTES) or labels.dtype != np.uint8:
        raise ValueError(f"labels are {labels.dtype}{labels.shape}, must be uint8[M, 32].")
    return GaussianBatch(ids, rows, anchors, labels)


def _move(
    rows: np.ndarray, anchors: np.ndarray, keyframes: np.ndarray, T: np.ndarray, q: np.ndarray
) -> None:
    """By columns: a product of many small matrices takes NumPy five times as long."""
    which = np.minimum(np.searchsorted(keyframes, anchors), len(keyframes) - 1)
    moved = np.flatnonzero(keyframes[which] == anchors)
    which = which[moved]
    p = rows[moved, 0:3].T.astype(float)
    for i in range(3):
        R0, R1, R2, t = T[:, i].T
        rows[moved, i] = R0[which] * p[0] + R1[which] * p[1] + R2[which] * p[2] + t[which]
    rows[moved, 6:10] = _product(q[which], rows[moved, 6:10])


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product [M, 4] of quaternions wxyz: the rotation q, then p."""
    pw, px, py, pz = p.T
    qw, qx, qy, qz = q.T
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )
