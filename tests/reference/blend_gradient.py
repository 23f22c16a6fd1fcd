"""NumPy reference implementation of the derivatives of the blending, summed by pairs."""

import numpy as np

TILE = 16  # Pixels.


def pair_sums_reference(
    splats: np.ndarray,
    listed: np.ndarray,
    starts: np.ndarray,
    ends: np.ndarray,
    by_planes: np.ndarray,
) -> np.ndarray:
    """Return the sums of each pair of a splat and a tile over the pixels of the tile, in float64.

    `ldo_service.kernels.gpu.blending` describes the arguments and the eleven sums.

    Args:
        splats: [N, 16].
        listed: Index of the splat of each pair, sorted by tile, then front to back, [P].
        starts: Index of the first pair of each tile, and P at the end, [tiles + 1].
        ends: Index after the last blended pair of each block of 4x4 pixels, [tiles, 16].
        by_planes: Derivatives of the loss with respect to the planes, [5, H, W].

    Returns:
        Sums of v, v dx, v dy, v dx^2, v dx dy, v dy^2, w dL/dcolor (3), w dL/ddepth and w, [P, 11].
    """
    height, width = by_planes.shape[1:]
    columns = -(-width // TILE)
    out = np.zeros((len(listed), 11))
    for tile in range(len(starts) - 1):
        pairs = slice(starts[tile], starts[tile + 1])
        left, top = tile % columns * TILE, tile // columns * TILE
        inside = slice(top, min(top + TILE, height)), slice(left, min(left + TILE, width))
        y, x = np.mgrid[inside]
        block = (y - top) // 4 * 4 + (x - left) // 4
        is_blended = np.arange(len(listed))[pairs, None, None] < ends[tile][block]
        out[pairs] = _sums_of_tile(
            splats[listed[pairs]].astype(float), x, y, is_blended, by_planes[:, *inside]
        )
    return out


def _sums_of_tile(
    splats: np.ndarray, x: np.ndarray, y: np.ndarray, is_blended: np.ndarray, by_planes: np.ndarray
) -> np.ndarray:
    """Return the sums [M, 11] of the M splats of a tile over its pixels [h, w]."""
    u, v, a, b, c, log2_opacity = splats.T[:6, :, None, None]
    dx, dy = x - u, y - v
    exact = 2.0 ** (a * dx**2 + b * dx * dy + c * dy**2 + log2_opacity)
    alpha = np.where(is_blended & (exact >= 1 / 255), np.minimum(exact, 0.99), 0.0)
    after = np.cumprod(1 - alpha, axis=0)  # Transmittance behind each splat.
    weight = alpha * after / (1 - alpha)
    # The derivative with respect to a splat's color, depth and opacity is q per unit of weight.
    by_color, by_depth, by_opacity = by_planes[:3], by_planes[3], by_planes[4]
    q = np.tensordot(splats[:, 8:11], by_color, 1) + splats[:, 11, None, None] * by_depth
    q = q + by_opacity
    seen = weight * q
    behind = np.cumsum(seen[::-1], axis=0)[::-1] - seen  # Sum over the splats behind.
    slope = np.where(exact < 0.99, weight * (q - behind / after), 0.0)
    terms = [slope, slope * dx, slope * dy, slope * dx**2, slope * dx * dy, slope * dy**2]
    terms += [weight * by for by in (*by_color, by_depth)]
    return np.stack([*terms, weight]).sum(axis=(2, 3)).T
