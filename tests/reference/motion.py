"""Reference of the motion of Gaussians with their anchor keyframes, in NumPy."""

import numpy as np


def move_rows(
    rows: np.ndarray, anchors: np.ndarray, keyframes: np.ndarray, T: np.ndarray, q: np.ndarray
) -> None:
    """Move rows in place by the transforms of their anchors.

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
