"""Where rays meet."""

import numpy as np


def meeting_point(origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, float]:
    """The point [3] nearest to all rays, and the widest angle in rad between two of them.

        min_x sum_i |(I - d_i d_i^T) (x - o_i)|^2

    origins [N, 3], in metres; rays [N, 3] of any length, N >= 2. Raises LinAlgError when all are
    parallel.
    """
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), (across @ origins[:, :, None])[..., 0].sum(axis=0))
    return point, float(np.arccos(np.clip((d @ d.T).min(), -1, 1)))
