"""NumPy implementation of `_surfaces`; see `ldo_service/kernels/_surfaces.pyi`."""

import numpy as np


def surfaces(depth_m: np.ndarray, rays: np.ndarray, step_ratio: float, step_m: float) -> np.ndarray:
    """Return points and unit normals [h w, 6] of the blocks of a view."""
    height, width = depth_m.shape
    points = rays.reshape(height, width, 3) * depth_m[..., None]
    result = np.zeros((height, width, 6))
    result[..., :3] = points
    n = np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1])
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
    z = depth_m[1:-1, 1:-1]
    near = z > 0
    neighbors = depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1]
    for other in neighbors:
        near &= (other > 0) & (abs(other - z) < step_ratio * z + step_m)
    result[1:-1, 1:-1, 3:][near] = n[near]
    return result.reshape(-1, 6)


def compare(
    there: np.ndarray,
    here: np.ndarray,
    basis: np.ndarray,
    T_here_there: np.ndarray,
    velocities: tuple[np.ndarray, np.ndarray],
    times_s: tuple[float, float],
    intrinsics: tuple[float, float, float, float],
    block: int,
    width: int,
    stride: int,
    max_step_ratio: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows [N, 13], depths [N] and indices [N, 2] of the compared blocks.

    `velocities` are those of both cameras, [6] each. `times_s` has the readout of depth and the
    delay of depth after color.
    """
    fx, fy, cx, cy = intrinsics
    height, (readout_s, delay_s) = len(there) // width, times_s
    chosen = np.zeros((height, width), bool)
    chosen[::stride, ::stride] = True
    a = np.flatnonzero(chosen.reshape(-1) & there[:, 3:].any(axis=1))
    R, t = T_here_there[:3, :3], T_here_there[:3, 3]

    def rows_of(v: np.ndarray) -> np.ndarray:
        return np.clip(v / (block * height - 1) - 0.5, -0.5, 0.5)

    def speeds(points: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.cross(velocity[:3], points) + velocity[3:]

    row_there = rows_of(block * (a // width + 0.5) - 0.5)
    speed_there = speeds(there[a, :3], velocities[0])
    at_color = there[a, :3] + speed_there * (delay_s + readout_s * row_there)[:, None]
    points = at_color @ R.T + t
    row_here = rows_of(fy * points[:, 1] / points[:, 2] + cy)
    speed_here = speeds(points, velocities[1])
    points = points - speed_here * (delay_s + readout_s * row_here)[:, None]
    moved = np.c_[speed_there @ R.T, speed_here, row_there, row_here]
    ahead = points[:, 2] > 0.1
    a, points, moved = a[ahead], points[ahead], moved[ahead]
    column = np.floor((fx * points[:, 0] / points[:, 2] + cx + 0.5) / block).astype(int)
    row = np.floor((fy * points[:, 1] / points[:, 2] + cy + 0.5) / block).astype(int)
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    a, points, moved, b = (x[seen] for x in (a, points, moved, row * width + column))
    seen = here[b, 3:].any(axis=1)
    a, points, moved, b = (x[seen] for x in (a, points, moved, b))
    place, n = here[b, :3], here[b, 3:]
    z = points[:, 2]
    plane_m = z * np.sum(place * n, axis=1) / np.sum(points * n, axis=1)
    seen = abs(z - plane_m) < max_step_ratio * z
    a, points, moved, b, place, n, z, plane_m = (
        x[seen] for x in (a, points, moved, b, place, n, z, plane_m)
    )
    mean_m = (z + plane_m) / 2
    middle = points * (mean_m / z)[:, None]
    before = (middle - t) @ R
    slope_there = np.sum((middle - t) * n, axis=1) * before[:, 2]
    slope_here = np.sum(place * n, axis=1) * place[:, 2] * (mean_m / plane_m) ** 2
    by_bias = slope_here[:, None] * basis[b] - slope_there[:, None] * basis[a]
    along_there, along_here = (np.sum(moved[:, k : k + 3] * n, axis=1) for k in (0, 3))
    by_readout = along_there * moved[:, 6] - along_here * moved[:, 7]
    by_times = np.c_[np.zeros(len(a)), by_readout, along_there - along_here]
    residual = np.sum((points - place) * n, axis=1)
    rows = np.c_[by_bias, by_times, np.cross(middle, n), n, residual]
    return rows, middle[:, 2], np.stack([a, b], axis=1)


def reproject(
    points: np.ndarray,
    pixels: np.ndarray,
    T: np.ndarray,
    intrinsics: tuple[float, float, float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reprojection errors [N, 2], derivatives [N, 2, 6], and points in the camera [N, 3]."""
    fx, fy, cx, cy = intrinsics
    moved = points @ T[:3, :3].T + T[:3, 3]
    x, y, z = moved.T
    inverse = 1.0 / np.where(abs(z) > 1e-6, z, 1e-6)
    a, b = x * inverse, y * inverse
    errors = np.stack([fx * a + cx, fy * b + cy], axis=1) - pixels
    zero = np.zeros_like(a)
    by_u = np.stack([-a * b, 1.0 + a * a, -b, inverse, zero, -a * inverse], axis=1)
    by_v = np.stack([-1.0 - b * b, a * b, a, zero, inverse, -b * inverse], axis=1)
    return errors, np.stack([fx * by_u, fy * by_v], axis=1), moved


def compare_features(
    there: np.ndarray,
    pixels_there: np.ndarray,
    depth_there: np.ndarray,
    pixels_here: np.ndarray,
    T_here_there: np.ndarray,
    velocities: tuple[np.ndarray, np.ndarray],
    bias: np.ndarray,
    times_s: tuple[float, float, float],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    block: int,
) -> np.ndarray:
    """Return two rows of 13 values for each feature, [2 M, 13]."""
    (width, height), (fx, fy, cx, cy) = size, intrinsics
    readout_s, depth_readout_s, delay_s = times_s
    R, t = T_here_there[:3, :3], T_here_there[:3, 3]

    def speeds(points: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.cross(velocity[:3], points) + velocity[3:]

    def turned(vectors: np.ndarray, velocity: np.ndarray, during_s: np.ndarray) -> np.ndarray:
        return vectors + np.cross(velocity[:3], vectors) * during_s[:, None]

    row_there, row_here = (p[:, 1] / (height - 1) - 0.5 for p in (pixels_there, pixels_here))
    u, v = pixels_there.T
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))], axis=1)
    x, y = (u - (width - 1) / 2) / (width / 2), (v - (height - 1) / 2) / (width / 2)
    basis = np.stack([x * x, x * y, y * y], axis=1)
    measured_m = 1.0 / np.maximum(1.0 / depth_there + basis @ bias, 0.02)
    # Speed at which the depth of fixed pixels decreases.
    columns, rows = width // block, height // block
    column, row = ((pixels_there + 0.5) // block).astype(int).T
    n = there[np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1), 3:]
    incidence = np.sum(n * rays, axis=1)
    is_known = abs(incidence) > 0.2
    along_n = np.sum(n * speeds(rays * measured_m[:, None], velocities[0]), axis=1)
    z_per_s = np.where(is_known, along_n / np.where(is_known, incidence, 1.0), 0.0)
    # The point at the time of the color row of the second view.
    z = measured_m + z_per_s * (delay_s + (depth_readout_s - readout_s) * row_there)
    points = rays * z[:, None]
    speed_there = speeds(points, velocities[0])
    at_middle = (points + speed_there * (readout_s * row_there)[:, None]) @ R.T + t
    speed_here = speeds(at_middle, velocities[1])
    moved = at_middle - speed_here * (readout_s * row_here)[:, None]
    errors, by_point, _ = reproject(moved, pixels_here, np.eye(4), intrinsics)
    by_place = by_point[..., 3:]
    along = turned(rays, velocities[0], readout_s * row_there) @ R.T
    along = turned(along, velocities[1], -readout_s * row_here)
    by_bias = -(by_place @ along[..., None]) * (measured_m**2)[:, None, None] * basis[:, None]
    by_depth = along * z_per_s[:, None]
    by_row = by_depth * row_there[:, None]
    by_readout = (speed_there @ R.T) * row_there[:, None] - speed_here * row_here[:, None]
    by_times = by_place @ np.stack([by_readout - by_row, by_row, by_depth], axis=-1)
    return np.concatenate([by_bias, by_times, by_point, errors[..., None]], axis=-1).reshape(-1, 13)
