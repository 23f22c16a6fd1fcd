"""The rigid motion between points that belong together. Conventions: `ldo_service.geometry`."""

import numpy as np


def align(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_target_points [4, 4] minimising sum |T p_k - q_k|^2 over p, q [M, 3], without scale.

    Umeyama, PAMI 1991, eq. 40-42, with the reflection guarded. Points on one line leave the
    rotation about it free; the residuals are the smallest all the same.
    """
    mean_p, mean_q = points.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - mean_q).T @ (points - mean_p))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))]) @ Vt
    T[:3, 3] = mean_q - T[:3, :3] @ mean_p
    return T
