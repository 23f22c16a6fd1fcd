"""Between two transforms, for many at once."""

import numpy as np

from . import se3


def blended(T_a: np.ndarray, T_b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """T [N, 4, 4] that lie `share` [N] of the way from T_a to T_b [N, 4, 4]: 0 is T_a, 1 is T_b.

        T = T_a (exp(s omega), s t),   (exp(omega), t) = T_a^-1 T_b

    Turned about one axis at an even rate, moved along a straight line. Each of the N by itself: the
    same bits whatever the others are.
    """
    T_a_b = se3.inverse(T_a) @ T_b
    part = np.zeros_like(T_a_b)
    part[:, :3, :3] = se3.rotation(_powers(quaternions(T_a_b[:, :3, :3]), share))
    part[:, :3, 3] = share[:, None] * T_a_b[:, :3, 3]
    part[:, 3, 3] = 1
    return T_a @ part


def quaternions(R: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [N, 4], w >= 0, of rotations R [N, 3, 3]; `se3.quaternion` of many."""
    x, y, z = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    # rows that are multiples of q: the one with the largest square loses no digits
    wx, wy, wz = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    squares = 1 + np.stack([x + y + z, x - y - z, y - x - z, z - x - y])
    w2, x2, y2, z2 = squares
    rows = np.array([[w2, wx, wy, wz], [wx, x2, xy, xz], [wy, xy, y2, yz], [wz, xz, yz, z2]])
    q = rows[squares.argmax(axis=0), :, np.arange(len(R))]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, :1] >= 0, q, -q)


def _powers(q: np.ndarray, share: np.ndarray) -> np.ndarray:
    """q^s [N, 4] of unit quaternions: turned by that share of the angle."""
    sin_half = np.linalg.norm(q[:, 1:], axis=1)
    half = share * np.arctan2(sin_half, q[:, 0])
    # sin(s h) / sin(h) tends to s
    scale = np.where(sin_half > 1e-9, np.sin(half) / np.maximum(sin_half, 1e-9), share)
    return np.column_stack([np.cos(half), scale[:, None] * q[:, 1:]])
