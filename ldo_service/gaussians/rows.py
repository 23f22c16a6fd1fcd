"""Rows of Gaussian parameters: their layout in memory, and motion with the anchor keyframes."""

import numpy as np

from ldo_service.geometry import se3

# Floats of a row: mean 3, log scale 3, quaternion wxyz 4, opacity logit, rgb 3, 2 unused.
ROW = 16


def aligned_rows(capacity: int) -> np.ndarray:
    """Return zeroed rows [capacity, 16]; each row fills one 64-byte cache line."""
    memory = np.zeros(capacity * ROW + 16, np.float32)
    skip = (-memory.ctypes.data % 64) // 4
    return memory[skip : skip + capacity * ROW].reshape(capacity, ROW)


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
    """Move rows in place by the transforms of their anchors.

    The computation runs column by column, since NumPy needs five times as long for a product of
    many small matrices.

    Args:
        rows: [M, 16].
        anchors: Anchor keyframe of each row, [M].
        keyframes: Ids of the moved keyframes, [K], ascending. Rows of other anchors stay.
        T: Transforms T_new_old of these keyframes, [K, 4, 4].
        q: Rotations of these transforms, [K, 4] wxyz.
    """
    which = np.minimum(np.searchsorted(keyframes, anchors), len(keyframes) - 1)
    moved = np.flatnonzero(keyframes[which] == anchors)
    which = which[moved]
    p = rows[moved, 0:3].T.astype(float)
    for i in range(3):
        R0, R1, R2, t = T[:, i].T
        rows[moved, i] = R0[which] * p[0] + R1[which] * p[1] + R2[which] * p[2] + t[which]
    rows[moved, 6:10] = _product(q[which], rows[moved, 6:10])


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the Hamilton product p q [M, 4] of quaternions wxyz: rotation q, followed by p."""
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
