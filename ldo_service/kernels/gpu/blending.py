"""Blending of splats front to back, and its derivative; see `kernels/blend.hpp`.

A splat is a projected Gaussian; the module `projection` describes its layout. A tile has 16x16
pixels, in 16 blocks of 4x4 pixels. A pair consists of a splat and a tile that the splat may reach.

A Triton program of one warp blends a tile. The pixels have the shape [16 pixels, 16 blocks],
because the pixels of a block finish together. With this order of axes, a thread holds eight pixels
of one block, so most of a sum over pixels stays in its registers. Each sum takes 5 shuffle
instructions; with the other order of axes, it would take 32.
"""

import triton
import triton.language as tl

from .arithmetic import PINNED, exp2, kernel
from .projection import LOG2_MIN_ALPHA, ROW, TILE

ONE_WARP = {"num_warps": 1, **PINNED}
# The compiler would stop at 128 registers without `maxnreg`, and spill eight bytes for sm_100.
BACKWARD = {**ONE_WARP, "maxnreg": 144}

LOG2_MAX_ALPHA = tl.constexpr(-0.0144995697)  # log2(0.99)
CAPPED = tl.constexpr(0.98999)  # A larger alpha was capped at 0.99, up to rounding.
STOP = tl.constexpr(1e-4)  # A pixel of less transmittance is finished.
BATCH = tl.constexpr(256)  # Each block checks its transmittance after this number of pairs.
CHUNK = tl.constexpr(16)  # The tile checks after this number of pairs whether all blocks finished.


@triton.jit
def pixels_of(tile, columns):
    """Return the positions of the pixels and blocks in the tile with number `tile`.

    Returns:
        Column and row of each pixel in the image, [16 pixels, 16 blocks] each. Then column and row
        of the first pixel of each block, [1, 16] each.
    """
    # The masks 3 and 12 replace remainders. If the compiler sees that four pixels are neighbors in
    # memory, it gives them to four threads, and the sums over pixels become shuffles.
    pixel, block = tl.arange(0, 16)[:, None], tl.arange(0, 16)[None, :]
    block_x = tile % columns * TILE + (block & 3) * 4
    block_y = tile // columns * TILE + (block & 12)
    return block_x + (pixel & 3), block_y + ((pixel & 12) >> 2), block_x, block_y


@triton.jit
def alpha_of(splat, px, py):
    """Return the capped alpha of a splat at pixels, and the pixel offsets from its center."""
    dx, dy = px - tl.load(splat), py - tl.load(splat + 1)
    a, b, c = tl.load(splat + 2), tl.load(splat + 3), tl.load(splat + 4)
    log2_alpha = dx * (dx * a + dy * b) + (dy * dy * c + tl.load(splat + 5))
    alpha = exp2(tl.minimum(tl.maximum(log2_alpha, -126.0), LOG2_MAX_ALPHA))
    return tl.where(log2_alpha >= LOG2_MIN_ALPHA, alpha, 0.0), dx, dy


@triton.jit
def largest_of_block(T):
    return tl.max(T, 0, keep_dims=True)


@kernel
def blend_forward(splats, listed, reached, starts, columns, width, height, planes, ends):
    """Blend the splats of each tile.

    A pair consists of a splat and a tile that the splat may reach. A tile has 16 blocks of pixels.
    The pairs of a tile are processed in batches of `BATCH` pairs. As in the C++ kernel, a block
    checks its transmittance after every fourth splat that reaches the block, and after each batch.
    The count of splats starts from 0 in each batch.

    Args:
        splats: [N, 16]; the module `projection` describes the layout.
        listed: Index of the splat of each pair, [P]. Pairs are sorted by tile, then front to back.
        reached: Bit mask of the blocks that the splat of each pair reaches, [P].
        starts: Index of the first pair of each tile, and P at the end, [tiles + 1].
        columns: Number of tiles in a row of the image.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        planes: Output, [5, height, width]: red, green, blue, weighted depth, opacity.
        ends: Output, [tiles, 16]: for each block, the index of its last blended pair plus 1.
    """
    tile = tl.program_id(0)
    x, y, block_x, block_y = pixels_of(tile, columns)
    px, py = x.to(tl.float32), y.to(tl.float32)
    T = tl.full([16, 16], 1.0, tl.float32)
    red, green, blue = T * 0.0, T * 0.0, T * 0.0
    depth = T * 0.0
    start, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    is_open = ((block_x < width) & (block_y < height)).to(tl.int32)
    count = is_open * 0
    block_end = tl.where(is_open != 0, end, start)
    block = tl.arange(0, 16)[None, :]
    i = start
    any_open = tl.max(tl.max(is_open, 1), 0)
    while (i < end) & (any_open != 0):
        chunk_end = tl.minimum(i + CHUNK, end)
        for j in range(i, chunk_end):
            bits = tl.load(reached + j)
            if bits != 0:
                splat = splats + tl.load(listed + j).to(tl.int64) * ROW
                alpha, _dx, _dy = alpha_of(splat, px, py)
                weight = tl.where(is_open != 0, alpha * T, 0.0)
                red += weight * tl.load(splat + 8)
                green += weight * tl.load(splat + 9)
                blue += weight * tl.load(splat + 10)
                depth += weight * tl.load(splat + 11)
                T = T - weight
                takes = (bits >> block) & is_open
                count += takes
                is_dark = (takes != 0) & (count % 4 == 0) & (largest_of_block(T) < STOP)
                block_end = tl.where(is_dark, j + 1, block_end)
                is_open = tl.where(is_dark, 0, is_open)
            if (j + 1 - start) % BATCH == 0:
                is_dark = (is_open != 0) & (largest_of_block(T) < STOP)
                block_end = tl.where(is_dark, j + 1, block_end)
                is_open = tl.where(is_dark, 0, is_open)
                count = count * 0
        i = chunk_end
        any_open = tl.max(tl.max(is_open, 1), 0)
    tl.store(ends + tile * 16 + block, block_end)
    is_inside = (x < width) & (y < height)
    size = width * height
    at = planes + y * width + x
    tl.store(at, red, is_inside)
    tl.store(at + size, green, is_inside)
    tl.store(at + 2 * size, blue, is_inside)
    tl.store(at + 3 * size, depth, is_inside)
    tl.store(at + 4 * size, 1.0 - T, is_inside)


@triton.jit
def over_pixels(values):
    return tl.sum(tl.sum(values, 0), 0)


@kernel
def blend_backward(
    splats, listed, reached, origins, starts, ends, columns, width, height, planes, by_planes, sums
):
    """Sum the derivatives of each pair of a splat and a tile over the pixels of the tile.

    Each pair has its own row of `sums`. The programs therefore need no atomic operations, and the
    bits of the result do not depend on the order of the programs.

    Let w be the blending weight of the splat at a pixel, (dx, dy) the offset of the pixel from the
    center of the splat, and v = dL/d ln(alpha). A row holds the sums of v, v dx, v dy, v dx^2,
    v dx dy, v dy^2, w dL/dcolor (3 values), w dL/ddepth and w.

    Let q = dL/dcolor . color + dL/ddepth z + dL/dopacity for a splat, and let m be the mean of q
    over the splats behind that splat. Then v = w (q - m); see `kernels/blend_gradient.hpp`.

    Args:
        splats: [N, 16]; the module `projection` describes the layout.
        listed: Index of the splat of each pair, [P]. Pairs are sorted by tile, then front to back.
        reached: Bit mask of the blocks that the splat of each pair reaches, [P].
        origins: Row of `sums` for each pair, [P]; the rows of one splat are contiguous.
        starts: Index of the first pair of each tile, and P at the end, [tiles + 1].
        ends: Output of `blend_forward`, [tiles, 16].
        columns: Number of tiles in a row of the image.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        planes: Output of `blend_forward`, [5, height, width].
        by_planes: Derivatives of the loss with respect to the planes, [5, height, width].
        sums: Output, [P, 16]; must hold zeros before the call.
    """
    tile = tl.program_id(0)
    x, y, _block_x, _block_y = pixels_of(tile, columns)
    px, py = x.to(tl.float32), y.to(tl.float32)
    is_inside = (x < width) & (y < height)
    size = width * height
    at = y * width + x
    by_red = tl.load(by_planes + at, is_inside, 0.0)
    by_green = tl.load(by_planes + at + size, is_inside, 0.0)
    by_blue = tl.load(by_planes + at + 2 * size, is_inside, 0.0)
    by_depth = tl.load(by_planes + at + 3 * size, is_inside, 0.0)
    by_opacity = tl.load(by_planes + at + 4 * size, is_inside, 0.0)
    behind = by_red * tl.load(planes + at, is_inside, 0.0)
    behind += by_green * tl.load(planes + at + size, is_inside, 0.0)
    behind += by_blue * tl.load(planes + at + 2 * size, is_inside, 0.0)
    behind += by_depth * tl.load(planes + at + 3 * size, is_inside, 0.0)
    behind += by_opacity * tl.load(planes + at + 4 * size, is_inside, 0.0)
    T = tl.where(is_inside, 1.0, 0.0)
    block_end = tl.load(ends + tile * 16 + tl.arange(0, 16)[None, :])
    lane = tl.arange(0, 16)
    for j in range(tl.load(starts + tile), tl.max(tl.max(block_end, 1), 0)):
        if tl.load(reached + j) != 0:
            splat = splats + tl.load(listed + j).to(tl.int64) * ROW
            alpha, dx, dy = alpha_of(splat, px, py)
            alpha = tl.where(j < block_end, alpha, 0.0)
            q = by_blue * tl.load(splat + 10) + (by_depth * tl.load(splat + 11) + by_opacity)
            q = by_red * tl.load(splat + 8) + (by_green * tl.load(splat + 9) + q)
            weight = alpha * T
            T = T - weight
            behind = behind - weight * q
            mean = tl.div_rn(behind, tl.maximum(T, 1e-30))
            v = tl.where(alpha < CAPPED, weight * (q - mean), 0.0)
            vx, vy = v * dx, v * dy
            out = tl.where(lane == 0, over_pixels(v), 0.0)
            out = tl.where(lane == 1, over_pixels(vx), out)
            out = tl.where(lane == 2, over_pixels(vy), out)
            out = tl.where(lane == 3, over_pixels(vx * dx), out)
            out = tl.where(lane == 4, over_pixels(vx * dy), out)
            out = tl.where(lane == 5, over_pixels(vy * dy), out)
            out = tl.where(lane == 6, over_pixels(weight * by_red), out)
            out = tl.where(lane == 7, over_pixels(weight * by_green), out)
            out = tl.where(lane == 8, over_pixels(weight * by_blue), out)
            out = tl.where(lane == 9, over_pixels(weight * by_depth), out)
            out = tl.where(lane == 10, over_pixels(weight), out)
            tl.store(sums + tl.load(origins + j).to(tl.int64) * 16 + lane, out)
