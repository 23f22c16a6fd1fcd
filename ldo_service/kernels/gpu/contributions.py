"""Median depth and contributions of the splats; see `kernels/contributions.hpp`.

Both blend the splats of a tile again, with the arithmetic of `blending.blend_forward`. A Triton
program of one warp computes a tile. Each pair of a splat and a tile has its own place in memory, so
no kernel needs an atomic operation.
"""

import triton.language as tl

from .arithmetic import kernel
from .blending import CHUNK, alpha_of, over_pixels, pixels_of
from .projection import ROW

HALF = tl.constexpr(0.5)  # The median is the depth at which less transmittance is left.


@kernel
def median_depths(splats, listed, reached, starts, columns, width, height, medians):
    """Find the depth at which the transmittance of each pixel falls below one half.

    Splats are sorted by depth, so this is the depth of the first splat behind which less than half
    of the transmittance is left. A tile is finished when all of its pixels have such a depth.

    Args:
        splats: [N, 16]; the module `projection` describes the layout.
        listed: Index of the splat of each pair, [P]. Pairs are sorted by tile, then front to back.
        reached: Bit mask of the blocks that the splat of each pair reaches, [P].
        starts: Index of the first pair of each tile, and P at the end, [tiles + 1].
        columns: Number of tiles in a row of the image.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        medians: Output, [height, width]; 0 where the transmittance stays higher.
    """
    tile = tl.program_id(0)
    x, y, _block_x, _block_y = pixels_of(tile, columns)
    px, py = x.to(tl.float32), y.to(tl.float32)
    is_inside = (x < width) & (y < height)
    T = tl.where(is_inside, 1.0, 0.0)
    median = T * 0.0
    i, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    largest = tl.max(tl.max(T, 0), 0)
    while (i < end) & (largest >= HALF):
        chunk_end = tl.minimum(i + CHUNK, end)
        for j in range(i, chunk_end):
            if tl.load(reached + j) != 0:
                splat = splats + tl.load(listed + j).to(tl.int64) * ROW
                alpha, _dx, _dy = alpha_of(splat, px, py)
                T = T - alpha * T
                is_first = (T < HALF) & (median == 0.0)
                median = tl.where(is_first, tl.load(splat + 11), median)
        i = chunk_end
        largest = tl.max(tl.max(T, 0), 0)
    tl.store(medians + y * width + x, median, is_inside)


@kernel
def contribute(
    splats, listed, reached, origins, starts, ends, columns, width, height, weights, top
):
    """Sum the blending weight of each pair, and find the splat of largest weight at each pixel.

    Args:
        splats: [N, 16]; the module `projection` describes the layout.
        listed: Index of the splat of each pair, [P]. Pairs are sorted by tile, then front to back.
        reached: Bit mask of the blocks that the splat of each pair reaches, [P].
        origins: Place of each pair in `weights`, [P]; the places of one splat are contiguous.
        starts: Index of the first pair of each tile, and P at the end, [tiles + 1].
        ends: Output of `blend_forward`, [tiles, 16].
        columns: Number of tiles in a row of the image.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        weights: Output, [P]: blending weight of the pair summed over the pixels of the tile; must
            hold zeros before the call.
        top: Output, [height, width] int32: index of the splat with the largest weight, -1 if no
            splat has weight. Among equal weights, the nearest splat counts.
    """
    tile = tl.program_id(0)
    x, y, _block_x, _block_y = pixels_of(tile, columns)
    px, py = x.to(tl.float32), y.to(tl.float32)
    is_inside = (x < width) & (y < height)
    T = tl.where(is_inside, 1.0, 0.0)
    largest = T * 0.0
    best = tl.full([16, 16], -1, tl.int32)
    block_end = tl.load(ends + tile * 16 + tl.arange(0, 16)[None, :])
    for j in range(tl.load(starts + tile), tl.max(tl.max(block_end, 1), 0)):
        if tl.load(reached + j) != 0:
            number = tl.load(listed + j)
            alpha, _dx, _dy = alpha_of(splats + number.to(tl.int64) * ROW, px, py)
            weight = tl.where(j < block_end, alpha * T, 0.0)
            T = T - weight
            best = tl.where(largest < weight, number, best)
            largest = tl.maximum(largest, weight)
            tl.store(weights + tl.load(origins + j), over_pixels(weight))
    tl.store(top + y * width + x, best, is_inside)


@kernel
def add_pairs(pair_weights, visible, n_visible, firsts, pairs, weights, BLOCK: tl.constexpr):
    """Add the weights of each splat over its tiles, in the order of the tiles; one lane a splat.

    Args:
        pair_weights: Output `weights` of `contribute`, [P].
        visible: Indices of the drawn splats, [n_visible].
        n_visible: Number of drawn splats.
        firsts: Place of each splat's first pair in `pair_weights`, [N].
        pairs: Number of each splat's pairs, [N].
        weights: Output, [n_visible]: blending weight of each splat summed over the pixels.
        BLOCK: Number of lanes of a Triton program.
    """
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_live = lane < n_visible
    i = tl.load(visible + lane, is_live, 0)
    first, count = tl.load(firsts + i, is_live, 0), tl.load(pairs + i, is_live, 0)
    total = tl.zeros([BLOCK], tl.float32)
    for k in range(tl.max(count)):
        total += tl.load(pair_weights + first + k, k < count, 0.0)
    tl.store(weights + lane, total, is_live)
