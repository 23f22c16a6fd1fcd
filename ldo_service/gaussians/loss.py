"""Image loss between a rendering and a frame.

The kernel is `kernels/loss.cpp`; its NumPy reference implementation is `tests/reference/loss.py`.
"""

from dataclasses import dataclass
from math import log10

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.kernels import _loss

from .exposure import Exposure

TILE = 16  # Side of a tile in pixels, as in the rasterizer.


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the terms of the image loss."""

    # Kerbl et al., 2023, eq. 7: (1 - lambda) L1 + lambda D-SSIM with lambda = 0.2.
    l1: float = 0.8
    d_ssim: float = 0.2
    depth: float = 0.5  # Weight per meter of mean depth error.

    def __post_init__(self) -> None:
        if not min(self.l1, self.d_ssim, self.depth) >= 0:
            raise ConfigError(
                named(self, "l1", "d_ssim", "depth") + ": weights must be at least 0."
            )


@dataclass(frozen=True, slots=True)
class ImageLoss:
    """Value of the image loss, and its terms as means over the image."""

    total: float  # Weighted sum of l1, d_ssim and depth_m.
    l1: float  # Mean absolute error of colors in 0..1.
    d_ssim: float  # 1 - SSIM.
    depth_m: float  # Mean over the pixels with measured depth.
    psnr_db: float


def image_loss(
    planes: np.ndarray,
    color: np.ndarray,
    depth_m: np.ndarray,
    exposure: Exposure,
    weights: LossWeights,
    by_planes: np.ndarray,
    *,
    mask: np.ndarray | None = None,
    tiles: np.ndarray | None = None,
    threads: int = 1,
) -> ImageLoss:
    """Compute the loss L between a rendering and a frame, and its derivative dL/dplanes.

        L = l1 mean|x - y| + d_ssim (1 - mean SSIM(x, y)) + depth mean|D - d|,  x = gain C + bias

    The factors l1, d_ssim and depth are the weights. SSIM has an 11x11 Gaussian window of sigma
    1.5 px, and pixels beyond the image count as 0, as in 3DGS (Wang et al., 2004; Kerbl et al.,
    2023). The result is bitwise equal for any number of threads.

    Args:
        planes: Rendering [5, H, W] float32: colors C, weighted depth D in meters, opacity (unused).
        color: Frame [3, H, W] uint8; y = color / 255.
        depth_m: Depth d of the frame, [H, W] float32. Pixels with 0 were not measured; the depth
            term ignores them.
        exposure: Gain and bias of the frame relative to the map.
        weights: Weights of the terms.
        by_planes: Output: dL/dplanes, [5, H, W] float32.
        mask: [H, W] uint8. Pixels with value 0 count as black in both images, and their depth is
            ignored. None uses all pixels.
        tiles: [ceil(H / 16), ceil(W / 16)] uint8. The pixels of a tile with value 0 are masked and
            excluded from the means. At least one tile must not be 0. None uses all tiles.
        threads: Threads of the kernel.

    Returns:
        The loss and its terms. They do not include the pixels of tiles with value 0.

    Raises:
        ValueError: The shapes of the arrays do not match.
    """
    share = 1.0  # Fraction of the pixels that are used.
    if tiles is not None:
        inside = tile_mask(tiles, *depth_m.shape)
        share = float(np.mean(inside))
        mask = inside if mask is None else inside * mask
    l1, d_ssim, depth, squared = _loss.image_loss(
        planes,
        color,
        depth_m,
        mask,
        exposure.matrix,
        weights.l1 / share,
        weights.d_ssim / share,
        weights.depth,
        by_planes,
        threads,
    )
    l1, d_ssim, squared = l1 / share, d_ssim / share, squared / share
    return ImageLoss(
        weights.l1 * l1 + weights.d_ssim * d_ssim + weights.depth * depth,
        l1,
        d_ssim,
        depth,
        -10 * log10(max(squared, 1e-20)),
    )


def tile_mask(tiles: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the mask [H, W] uint8 that is 1 at the pixels of tiles with a value other than 0.

    Args:
        tiles: [ceil(H / 16), ceil(W / 16)].
        height: H.
        width: W.

    Raises:
        ValueError: The tiles have another shape, or all are 0.
    """
    shape = -(-height // TILE), -(-width // TILE)
    if tiles.shape != shape or not tiles.any():
        raise ValueError(
            f"tiles of shape {tiles.shape} must have shape {shape} and must not all be 0."
        )
    pixels = (tiles != 0).repeat(TILE, axis=0).repeat(TILE, axis=1)[:height, :width]
    return np.ascontiguousarray(pixels, np.uint8)
