"""Means of rendered color and opacity over square blocks, to estimate the exposure."""

import triton.language as tl

from .arithmetic import kernel


@kernel
def block_means(planes, width, height, side, across, down, out, LANES: tl.constexpr):
    """Average color and opacity over blocks of side x side pixels; each program computes one mean.

    Args:
        planes: Rendering, [5, height, width]: red, green, blue, weighted depth, opacity.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        side: Side of a block, pixels.
        across: Number of complete blocks in a row of the image.
        down: Number of complete blocks in a column of the image.
        out: Output, [4, down, across]: means of red, green, blue and opacity.
        LANES: A power of two that is at least side * side.
    """
    number = tl.program_id(0)
    blocks = across * down
    channel, block = number // blocks, number % blocks
    plane = tl.where(channel == 3, 4, channel)
    lane = tl.arange(0, LANES)
    x, y = block % across * side + lane % side, block // across * side + lane // side
    at = planes + plane * width * height + y * width + x
    total = tl.sum(tl.load(at, lane < side * side, 0.0), 0)
    tl.store(out + number, tl.div_rn(total, (side * side).to(tl.float32)))
