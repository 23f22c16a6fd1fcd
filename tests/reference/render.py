"""NumPy reference implementation of `render`, with every Gaussian in every pixel.

It is slow, needs memory for H W N values, and is meant for small scenes in tests. It assigns to no
array and takes the array module as `xp`, so that `autograd.numpy` can differentiate it.
"""

from typing import Any

import numpy as np

from ldo_service.gaussians.renderer import Contributions, Rendering
from ldo_service.geometry import Camera


def rotations(quats: Any, xp: Any = np) -> Any:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4] wxyz of any length."""
    w, x, y, z = (quats / xp.sqrt(xp.sum(quats**2, axis=1, keepdims=True))).T
    return xp.stack(
        [
            xp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            xp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )


def project(
    rows: Any, camera: Camera, T_camera_map: Any, xp: Any = np, low_pass: float = 0.3
) -> tuple[Any, Any, Any]:
    """Compute image means [N, 2], image covariances [N, 2, 2] in px^2, and depths [N] in meters."""
    R, t = T_camera_map[:3, :3], T_camera_map[:3, 3]
    p = rows[:, :3] @ R.T + t
    z = xp.maximum(p[:, 2], 0.05)
    x, y = p[:, 0] / z, p[:, 1] / z
    margin_x, margin_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    near_x = xp.clip(
        x, -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x
    )
    near_y = xp.clip(
        y, -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y
    )
    zero = xp.zeros_like(z)
    J = xp.stack(
        [
            xp.stack([camera.fx / z, zero, -camera.fx * near_x / z], -1),
            xp.stack([zero, camera.fy / z, -camera.fy * near_y / z], -1),
        ],
        1,
    )
    M = J @ R @ rotations(rows[:, 6:10], xp) * xp.exp(rows[:, None, 3:6])
    covariances = M @ xp.swapaxes(M, 1, 2) + low_pass * xp.eye(2)
    return (
        xp.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1),
        covariances,
        p[:, 2],
    )


def render_reference(
    rows: Any, camera: Camera, T_camera_map: Any, xp: Any = np, binning: int = 1
) -> Rendering:
    """Render like `render`, in the precision of `rows`, without the early stop at T < 1e-4.

    With `binning` b, each pixel is the mean of b x b full pixels.
    """
    box = (1 - 1 / binning**2) / 12
    low_pass = 0.3 / binning**2 + box
    means, covariances, z = project(rows, camera, T_camera_map, xp, low_pass)
    order = np.argsort(z, kind="stable")
    order = order[z[order] >= 0.05]
    means, covariances, z = means[order], covariances[order], z[order]
    opacities, colors = 1 / (1 + xp.exp(-rows[order, 10])), rows[order, 11:14]
    if box:  # The average over a box keeps the integral of a splat and lowers its peak.
        narrow = xp.linalg.det(covariances - box * xp.eye(2))
        opacities = opacities * xp.sqrt(narrow / xp.linalg.det(covariances))

    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    d = xp.stack([u, v], -1)[..., None, :] - means  # [H, W, N, 2].
    q = xp.einsum("hwni,nij,hwnj->hwn", d, xp.linalg.inv(covariances), d)
    alpha = xp.minimum(opacities * xp.exp(-0.5 * q), 0.99)
    alpha = xp.where(alpha >= 1 / 255, alpha, 0.0)
    log_pass = xp.log(1 - alpha)
    after = xp.cumsum(log_pass, axis=2)  # Log transmittance behind each Gaussian.
    weights = alpha * xp.exp(after - log_pass)

    behind_half = np.concatenate([after < np.log(0.5), np.ones_like(u[..., None], bool)], axis=2)
    median = np.append(z, 0.0)[np.argmax(behind_half, axis=2)]
    opacity = xp.sum(weights, axis=2)
    images = weights @ colors, weights @ z, median, opacity
    return Rendering(*images, contributions_reference(weights, order) if xp is np else None)


def contributions_reference(weights: np.ndarray, order: np.ndarray) -> Contributions:
    """Compute contributions from weights [H, W, N] of the rows `order` [N], near to far."""
    nobody = np.full((*weights.shape[:2], 1), np.finfo(weights.dtype).tiny)
    top = np.append(order, -1)[np.argmax(np.concatenate([weights, nobody], axis=2), axis=2)]
    by_row = np.zeros(max(order, default=-1) + 1)
    by_row[order] = weights.sum(axis=(0, 1))
    indices = np.flatnonzero(by_row)
    return Contributions(indices, by_row[indices], top)
