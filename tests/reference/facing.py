"""NumPy reference implementation of the angles between normals and viewing rays."""

import numpy as np


def facing_cosines(
    depth_m: np.ndarray, ray_x: np.ndarray, ray_y: np.ndarray, mask: np.ndarray
) -> np.ndarray:
    """Return the absolute cosine at each pixel of a region with depth and a normal, row by row.

    Args:
        depth_m: Depth in a window around the region, [h, w], meters; 0 where unknown.
        ray_x: First coordinates of the rays of the columns, [w].
        ray_y: Second coordinates of the rays of the rows, [h]. The third coordinates are 1.
        mask: Pixels of the region, [h, w] bool.
    """
    z, across, down = depth_m.astype(np.float64), ray_x[None], ray_y[:, None]
    x, y = across * z, down * z
    x_u, y_u, z_u = (np.gradient(along, axis=1) for along in (x, y, z))
    x_v, y_v, z_v = (np.gradient(along, axis=0) for along in (x, y, z))
    n_x, n_y, n_z = y_u * z_v - z_u * y_v, z_u * x_v - x_u * z_v, x_u * y_v - y_u * x_v
    lengths = np.sqrt(n_x * n_x + n_y * n_y + n_z * n_z) * np.sqrt(across**2 + down**2 + 1.0)
    usable = mask & (z > 0) & (lengths > 0)
    return np.abs((n_x * across + n_y * down + n_z)[usable]) / lengths[usable]
