"""How far a rendering is from a frame. The kernel is `kernels/loss.cpp`, its plain twin
`tests/reference/loss.py`."""

from dataclasses import dataclass
from math import log10

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.kernels import _loss

from .exposure import Exposure

TILE = 16  # pixels across


@dataclass(frozen=True, slots=True)
class LossWeights:
    l1: float = 0.8  # Kerbl et al. 2023, eq. 7: (1 - lambda) L1 + lambda D-SSIM,
    d_ssim: float = 0.2  # lambda = 0.2
    depth: float = 0.5  # per metre of mean depth error

    def __post_init__(self) -> None:
        if not min(self.l1, self.d_ssim, self.depth) >= 0:
            raise ConfigError(
                named(self, "l1", "d_ssim", "depth") + ": weights must not be negative."
            )


@dataclass(frozen=True, slots=True)
class ImageLoss:
    """total = weighted sum of l1, d_ssim and depth_m, which are means over the image."""

    total: float
    l1: float  # of colours in 0..1
    d_ssim: float  # 1 - SSIM
    depth_m: float  # over the pixels whose depth was measured
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
    """Compare a rendering with a frame, and write dL/dplanes to `by_planes` [5, H, W] float32.

        L = l1 mean|x - y| + d_ssim (1 - mean SSIM(x, y)) + depth mean|D - d|,  x = gain C + bias

    planes   [5, H, W] float32: colours C, weighted depth D in metres, opacity (unused)
    color    [3, H, W] uint8, y = color / 255
    depth_m  [H, W] float32, d; 0 where not measured, which does not count
    mask     [H, W] uint8: where it is 0 both images are taken as black and depth does not count
    tiles    [ceil(H / 16), ceil(W / 16)] uint8: the pixels of tiles where it is 0 are masked, and
             means are over the pixels of the others alone, of which there must be some
    SSIM has an 11x11 Gaussian window of sigma 1.5 px and sees zeros beyond the image, as in 3DGS
    (Wang et al. 2004; Kerbl et al. 2023). Raises ValueError for arrays that do not fit. Bitwise
    equal for any number of threads.
    """
    share = 1.0  # of the pixels
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
    """The pixels [H, W] uint8 of the tiles where `tiles` [ceil(H / 16), ceil(W / 16)] is not 0.

    Raises ValueError for tiles of another shape, and where none is wanted.
    """
    shape = -(-height // TILE), -(-width // TILE)
    if tiles.shape != shape or not tiles.any():
        raise ValueError(f"tiles {tiles.shape} must have shape {shape} and a tile that is wanted.")
    pixels = (tiles != 0).repeat(TILE, axis=0).repeat(TILE, axis=1)[:height, :width]
    return np.ascontiguousarray(pixels, np.uint8)
