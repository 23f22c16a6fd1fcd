"""Between two transforms, for many at once."""

import numpy as np
from scipy.spatial.transform import Rotation

from . import se3


def blended(T_a: np.ndarray, T_b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """T [N, 4, 4] that lie `share` [N] of the way from T_a to T_b [N, 4, 4]: 0 is T_a, 1 is T_b.

        T = T_a (exp(s omega), s t),   (exp(omega), t) = T_a^-1 T_b

    Turned about one axis at an even rate, moved along a straight line.
    """
    T_a_b = se3.inverse(T_a) @ T_b
    omega = Rotation.from_matrix(T_a_b[:, :3, :3]).as_rotvec()
    part = np.tile(np.eye(4), (len(T_a_b), 1, 1))
    part[:, :3, :3] = Rotation.from_rotvec(share[:, None] * omega).as_matrix()
    part[:, :3, 3] = share[:, None] * T_a_b[:, :3, 3]
    return T_a @ part


def quaternions(R: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [N, 4], w >= 0, of rotations R [N, 3, 3]; `se3.quaternion` of many."""
    xyzw = Rotation.from_matrix(R).as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]]
