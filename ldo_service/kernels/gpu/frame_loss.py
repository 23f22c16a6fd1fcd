"""Loss between a rendering and a keyframe, and its derivatives with respect to the rendering."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import loss
from .arithmetic import PINNED
from .arrays import Arrays
from .plane_rendering import FOUR_WARPS, PLANES, PlaneRendering, programs_for

PIXEL_LANES = 256  # Lanes of the programs, each of which computes one pixel value.
# `means_along_rows` needs up to 72 registers with four warps, and up to 51 with eight.
ROW_SUMS = {"num_warps": 8, **PINNED}


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """Images of a keyframe on the device.

    Attributes:
        color: [3, H, W] uint8.
        depth_m: [H, W] float32; 0 where not measured.
        mask: [H, W] uint8, 0 where the pixel is ignored.
        measured: Number of pixels that have a depth and are not ignored.
    """

    color: Any
    depth_m: Any
    mask: Any
    measured: int


def image_loss(
    arrays: Arrays,
    rendering: PlaneRendering,
    frame: Frame,
    exposure: np.ndarray,
    weights: tuple[float, float, float],
) -> tuple[Any, np.ndarray]:
    """Compare a rendering with a frame; `gaussians.loss.image_loss` describes the loss.

    Args:
        arrays: Arrays of the device.
        rendering: The rendering.
        frame: Images of the keyframe, of the same size as the rendering.
        exposure: Gains of the three channels, then biases, [2, 3] float32.
        weights: Weights of L1, D-SSIM and depth.

    Returns:
        dL/dplanes [5, H, W] on the device: red, green, blue, weighted depth, opacity. Then the
        means of L1, D-SSIM, depth error in meters and squared color error, [4] float64.
    """
    width, height, planes = rendering.width, rendering.height, rendering.planes
    pixels = width * height
    values = 3 * pixels
    by_planes = arrays.empty((PLANES, height, width), np.float32)
    along, derivatives = (arrays.empty((k, values), np.float32) for k in (4, 3))
    seen = planes, frame.color, frame.mask, arrays.upload(exposure)
    grid, pixel_grid = programs_for(values, PIXEL_LANES), programs_for(pixels, PIXEL_LANES)
    l1s, ssims, squares = (arrays.empty(grid, np.float32) for _ in range(3))
    errors = arrays.empty(pixel_grid, np.float32)
    options = {"BLOCK": PIXEL_LANES, **FOUR_WARPS}
    per_value = 1 / np.float32(values)
    l1, d_ssim, depth = (np.float32(weight) for weight in weights)
    measured = max(frame.measured, 1)
    loss.means_along_rows[grid](*seen, width, height, along, BLOCK=PIXEL_LANES, **ROW_SUMS)
    loss.ssim_derivatives[grid](along, width, height, derivatives, ssims, **options)
    loss.derivatives_along_rows[grid](derivatives, width, height, along, **options)
    loss.color_gradient[grid](
        *seen,
        along,
        width,
        height,
        float(l1 * per_value),
        float(-d_ssim * per_value),
        by_planes,
        l1s,
        squares,
        **options,
    )
    loss.depth_gradient[pixel_grid](
        planes,
        frame.depth_m,
        frame.mask,
        width,
        height,
        float(depth / np.float32(measured)),
        by_planes,
        errors,
        **options,
    )
    sums = [arrays.download(x).sum(dtype=float) for x in (l1s, ssims, errors, squares)]
    means = np.array(sums) / [values, values, measured, values]
    means[1] = 1 - means[1]
    return by_planes, means
