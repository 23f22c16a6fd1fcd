"""Rows of Gaussian parameters: their layout in memory, and motion with the anchor keyframes."""

import numpy as np

from ldo_service.geometry import se3
from ldo_service.kernels import _motion

# Number of rows that are copied at a time, so that the copy stays in the CPU cache.
_ROWS_AT_ONCE = 4096
# Floats of a row: mean 3, log scale 3, quaternion wxyz 4, opacity logit, rgb 3, 2 unused.
ROW = 16


def aligned_rows(capacity: int) -> np.ndarray:
    """Return zeroed rows [capacity, 16]; each row fills one 64-byte cache line."""
    memory = np.zeros(capacity * ROW + 16, np.float32)
    skip = (-memory.ctypes.data % 64) // 4
    return memory[skip : skip + capacity * ROW].reshape(capacity, ROW)


def keep_rows(array: np.ndarray, first: int, kept: np.ndarray) -> None:
    """Move some rows of an array together, in place: row `kept[i]` becomes row `first + i`.

    No copy of the whole array is made. The rows after the last moved one stay as they are.

    Args:
        array: Array [N, ...].
        first: Number of the first row that is overwritten.
        kept: Numbers of the rows to move, [M] int64, ascending, the first at least `first`.
    """
    for start in range(0, len(kept), _ROWS_AT_ONCE):
        part = kept[start : start + _ROWS_AT_ONCE]
        array[first + start : first + start + len(part)] = array[part]


def transform_rows(rows: np.ndarray, T_new_old: np.ndarray) -> np.ndarray:
    """Return copies of rows [M, 16] moved by T_new_old [4, 4], as in `GaussianMap.move_anchors`."""
    out = aligned_rows(len(rows))
    out[:] = rows
    T = np.asarray(T_new_old, float)[None]
    q = se3.quaternion(T[:, :3, :3])
    move_rows(out, np.zeros(len(rows), np.int32), np.zeros(1, np.int64), T, q)
    return out


def move_rows(
    rows: np.ndarray, anchors: np.ndarray, keyframes: np.ndarray, T: np.ndarray, q: np.ndarray
) -> None:
    """Move rows in place by the transforms of their anchors: mean <- T mean, quat <- q quat.

    The computation uses float64 without fused operations, so that the result is bitwise equal on
    every machine.

    Args:
        rows: Gaussians, [M, 16]; `ROW` lists the columns.
        anchors: Id of the anchor keyframe of each row, [M] int32.
        keyframes: Ids of the moved keyframes, [K] int64, ascending. Rows of other anchors stay.
        T: Motions T_new_old of these keyframes in the map frame, [K, 4, 4].
        q: Rotations of these transforms, [K, 4] wxyz.
    """
    _motion.move_rows(rows, anchors, keyframes, np.ascontiguousarray(T), np.ascontiguousarray(q))
