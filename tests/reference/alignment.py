"""NumPy reference implementation of `alignment.normal_equations`, in float64."""

import numpy as np

from ldo_service.geometry import se3
from ldo_service.tracking.alignment import (
    DEGREES_OF_FREEDOM,
    INLIER_SIGMA,
    BrightnessModel,
    NormalEquations,
    ResidualConfig,
    ResidualStatistics,
)
from ldo_service.tracking.pyramid import Level


def normal_equations(
    points: np.ndarray,
    target: Level,
    T_camera_reference: np.ndarray,
    appearance: BrightnessModel,
    config: ResidualConfig,
) -> NormalEquations:
    """Compute the result of `alignment.normal_equations`, equal up to rounding."""
    points = points.astype(float)
    R, camera = T_camera_reference[:3, :3], target.camera
    p = se3.transform(T_camera_reference, points[:3].T)
    shade, n = points[3], points[4:].T @ R.T

    in_front = p[:, 2] > 1e-3
    u, v = camera.project(np.where(in_front[:, None], p, [0.0, 0.0, 1.0])).T
    inside = in_front & (u >= 1) & (v >= 1) & (u < camera.width - 2) & (v < camera.height - 2)
    p, shade, n, u, v = p[inside], shade[inside], n[inside], u[inside], v[inside]
    column, row = (u + 0.5).astype(int), (v + 0.5).astype(int)
    depth = target.depth_m[row, column].astype(float)
    shown = ~((depth > 0) & (p[:, 2] > depth * (1 + config.occlusion)))
    p, shade, n, u, v = p[shown], shade[shown], n[shown], u[shown], v[shown]
    column, row, depth = column[shown], row[shown], depth[shown]

    is_usable = (shade > 0) & is_unclipped(target, u, v)
    r, J = photometric(
        target, p[is_usable], shade[is_usable], u[is_usable], v[is_usable], appearance
    )
    H_color, g_color, color = _weighted(r, J, np.full(len(r), appearance.intensity_sigma))

    q = np.column_stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy])
    q = np.column_stack([q, np.ones(len(q))]) * depth[:, None]
    paired = (depth > 0) & (n.any(axis=1)) & (np.abs(p[:, 2] - depth) < config.gate * p[:, 2])
    r, J = geometric(p[paired], n[paired], q[paired])
    sigma_m = appearance.depth_noise_scale * config.noise.sigma_m(p[paired, 2])
    H_depth, g_depth, depths = _weighted(r, J, sigma_m)
    return NormalEquations(
        H_color + H_depth, g_color + g_depth, float(len(p)), color, depths, np.zeros((0, 2, 8))
    )


def photometric(
    target: Level,
    p: np.ndarray,
    shade: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    appearance: BrightnessModel,
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals [N] and Jacobians [N, 8] of camera points p [N, 3] at pixels (u, v) [N]."""
    intensity, gradient_u, gradient_v = bilinear(target.texels[..., :3], u, v).T
    x, y, z = p.T
    gx, gy = gradient_u * target.camera.fx / z, gradient_v * target.camera.fy / z
    g = np.column_stack([gx, gy, -(gx * x + gy * y) / z])  # dI/dp
    r = intensity - appearance.gain * shade - appearance.bias
    return r, np.column_stack([np.cross(g, p), -g, -shade, -np.ones(len(r))])


def is_unclipped(target: Level, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return where none of the four pixels around (u, v) [N] is clipped, [N] bool."""
    column, row = u.astype(int), v.astype(int)
    around = [target.texels[row + i, column + j, 0] for i in (0, 1) for j in (0, 1)]
    return np.min(around, axis=0) > 0


def geometric(p: np.ndarray, n: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals [N] and Jacobians [N, 8]; the normals rotate with the reference.

    Args:
        p: Points in the camera frame, [N, 3], meters.
        n: Normals in the camera frame, [N, 3].
        q: Points of the target at the nearest pixels, [N, 3], meters.
    """
    return np.sum(n * (p - q), axis=1), np.column_stack([np.cross(n, q), -n, np.zeros((len(p), 2))])


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Sample an image [H, W, C] at pixel coordinates u, v [N]; return [N, C]."""
    column, row = u.astype(int), v.astype(int)
    du, dv = (u - column)[:, None], (v - row)[:, None]
    upper = (1 - du) * image[row, column] + du * image[row, column + 1]
    lower = (1 - du) * image[row + 1, column] + du * image[row + 1, column + 1]
    return (1 - dv) * upper + dv * lower


def _weighted(
    r: np.ndarray, J: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray, ResidualStatistics]:
    """Return the Hessian, the gradient and the statistics of robustly weighted residuals."""
    squares = (r / sigma) ** 2
    weights = (DEGREES_OF_FREEDOM + 1) / (DEGREES_OF_FREEDOM + squares)
    scaled = J * (weights / sigma**2)[:, None]
    inliers = int(np.sum(squares < INLIER_SIGMA**2))
    return J.T @ scaled, scaled.T @ r, ResidualStatistics(len(r), inliers, float(weights @ squares))
