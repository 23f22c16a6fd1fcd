"""NumPy reference implementation of `image_loss`, which `autograd` can differentiate."""

from typing import Any

import numpy as np

WINDOW = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
WINDOW = WINDOW / WINDOW.sum()


def windowed_mean(image: Any, xp: Any = np) -> Any:
    """Filter an image [H, W, C] with the 11x11 Gaussian window; it is zero beyond its edges."""
    for axis in (0, 1):
        length = image.shape[axis]
        padding = [(5, 5) if k == axis else (0, 0) for k in range(3)]
        padded = xp.pad(image, padding, "constant")
        rest = (slice(None),) * axis
        image = sum(WINDOW[k] * padded[(*rest, slice(k, k + length))] for k in range(11))
    return image


def ssim(a: Any, b: Any, xp: Any = np) -> Any:
    """Compute the structural similarity [H, W, C] of images in 0..1 (Wang et al. 2004)."""
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = windowed_mean(a, xp), windowed_mean(b, xp)
    variance_a = windowed_mean(a * a, xp) - mean_a**2
    variance_b = windowed_mean(b * b, xp) - mean_b**2
    covariance = windowed_mean(a * b, xp) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return luminance * (2 * covariance + c2) / (variance_a + variance_b + c2)


def loss_reference(
    planes: Any,
    exposure: Any,
    color: np.ndarray,
    depth_m: np.ndarray,
    mask: np.ndarray,
    weights: tuple[float, float, float],
    xp: Any = np,
) -> Any:
    """Compute the total loss of `image_loss`.

    Args:
        planes: Red, green, blue, weighted depth and opacity, [5, H, W].
        exposure: Gains and biases of the three channels, [2, 3].
        color: Color planes of the frame, [3, H, W], 0..1.
        depth_m: Depth of the frame, [H, W], meters; 0 where not measured.
        mask: Pixels that count, [H, W], 0 or 1.
        weights: Weights of L1, D-SSIM and depth.
        xp: Array module, `numpy` or `autograd.numpy`.
    """
    rendered = xp.transpose(planes[:3], (1, 2, 0)) * exposure[0] + exposure[1]
    rendered = rendered * mask[..., None]
    target = color.transpose(1, 2, 0) * mask[..., None]
    measured = (depth_m > 0) * mask
    l1 = xp.mean(xp.abs(rendered - target))
    d_ssim = 1 - xp.mean(ssim(rendered, target, xp))
    depth = xp.sum(measured * xp.abs(planes[3] - depth_m)) / max(measured.sum(), 1)
    return weights[0] * l1 + weights[1] * d_ssim + weights[2] * depth
