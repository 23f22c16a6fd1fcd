"""Image loss of a rendering and its derivatives: L1, SSIM and depth; see `kernels/loss.cpp`.

The loss compares two images x and y with values in 0..1. x is the rendering with the exposure of
the frame applied, and y is the frame. SSIM uses means over a Gaussian window, which is applied
along rows and then along columns. The kernels first apply the window to the images. They then apply
it to the derivatives of SSIM with respect to these means.

One lane of a Triton program computes one value of an image [3, H, W]. `at` is the index of the
value in [3, H, W], and `pixel` is the index of its pixel in [H, W]. `is_live` is false for lanes of
the last program that have no value.
"""

import triton
import triton.language as tl

from .arithmetic import kernel, sign

# exp(-k^2 / (2 1.5^2)) / sum, for k = 0 .. 5, as in `kernels/gaussian_window.hpp`.
TAP0 = tl.constexpr(0.26601171)
TAP1 = tl.constexpr(0.21300553)
TAP2 = tl.constexpr(0.10936069)
TAP3 = tl.constexpr(0.03600077)
TAP4 = tl.constexpr(0.00759876)
TAP5 = tl.constexpr(0.00102838)
C1 = tl.constexpr(0.01 * 0.01)  # Constants of SSIM, for values in 0..1.
C2 = tl.constexpr(0.03 * 0.03)


@triton.jit
def tap(k: tl.constexpr):
    """Return the weight of the SSIM window k pixels from its middle; the 11 weights add up to 1."""
    if k == 0:  # noqa: SIM116
        return TAP0
    elif k == 1:  # noqa: RET505
        return TAP1
    elif k == 2:
        return TAP2
    elif k == 3:
        return TAP3
    elif k == 4:
        return TAP4
    else:
        return TAP5


@triton.jit
def place_of(width, height, BLOCK: tl.constexpr):
    """Return `at`, channel, `pixel`, row, column and `is_live` of each lane.

    The module describes `at`, `pixel` and `is_live`.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    size = width * height
    pixel = at % size
    return at, at // size, pixel, pixel // width, pixel % width, at < 3 * size


@triton.jit
def exposed_at(planes, color, mask, exposure, at, channel, pixel, is_live):
    """Return the values of images x and y, whether the mask keeps the pixel, and the gain.

    The values are 0 where the mask is 0. The docstring of the module describes x and y.
    """
    counts = is_live & (tl.load(mask + pixel, is_live, 0) != 0)
    gain = tl.load(exposure + channel, is_live, 0.0)
    bias = tl.load(exposure + 3 + channel, is_live, 0.0)
    x = gain * tl.load(planes + at, counts, 0.0) + bias
    y = tl.load(color + at, counts, 0).to(tl.float32) * (1.0 / 255.0)
    return tl.where(counts, x, 0.0), tl.where(counts, y, 0.0), counts, gain


@kernel
def means_along_rows(planes, color, mask, exposure, width, height, out, BLOCK: tl.constexpr):
    """Apply the SSIM window along rows to x, y, x^2 + y^2 and x y; the module describes x and y.

    Args:
        planes: Rendering, [5, H, W]: red, green, blue, weighted depth, opacity.
        color: Frame, [3, H, W] uint8.
        mask: 0 for ignored pixels, [H, W] uint8.
        exposure: Gains of the three channels, then biases, [2, 3].
        width: Width W of the images, pixels.
        height: Height H of the images, pixels.
        out: Output, [4, 3, H, W]: means of the four images along rows.
        BLOCK: Number of lanes of a Triton program.
    """
    at, channel, pixel, _row, column, is_live = place_of(width, height, BLOCK)
    x0, y0, _, _ = exposed_at(planes, color, mask, exposure, at, channel, pixel, is_live)
    x, y, squares = x0 * tap(0), y0 * tap(0), (x0 * x0 + y0 * y0) * tap(0)
    product = (x0 * y0) * tap(0)
    for k in tl.static_range(1, 6):
        is_right, is_left = is_live & (column + k < width), is_live & (column - k >= 0)
        x1, y1, _, _ = exposed_at(
            planes, color, mask, exposure, at + k, channel, pixel + k, is_right
        )
        x2, y2, _, _ = exposed_at(
            planes, color, mask, exposure, at - k, channel, pixel - k, is_left
        )
        x += (x1 + x2) * tap(k)
        y += (y1 + y2) * tap(k)
        squares += ((x1 * x1 + y1 * y1) + (x2 * x2 + y2 * y2)) * tap(k)
        product += (x1 * y1 + x2 * y2) * tap(k)
    size = 3 * width * height
    tl.store(out + at, x, is_live)
    tl.store(out + size + at, y, is_live)
    tl.store(out + 2 * size + at, squares, is_live)
    tl.store(out + 3 * size + at, product, is_live)


@triton.jit
def window_along_columns(images, at, row, width, height, is_live):
    """Apply the SSIM window along columns to images [3, H, W], at the index `at` of each lane."""
    out = tl.load(images + at, is_live, 0.0) * tap(0)
    for k in tl.static_range(1, 6):
        below = tl.load(images + at + k * width, is_live & (row + k < height), 0.0)
        above = tl.load(images + at - k * width, is_live & (row - k >= 0), 0.0)
        out += (below + above) * tap(k)
    return out


@kernel
def ssim_derivatives(along_rows, width, height, out, ssims, BLOCK: tl.constexpr):
    """Apply the SSIM window along columns, and compute SSIM and its derivatives.

    Args:
        along_rows: Output of `means_along_rows`, [4, 3, H, W].
        width: Width W of the images, pixels.
        height: Height H of the images, pixels.
        out: Output, [3, 3, H, W]: derivatives of SSIM with respect to the window means of x,
            x^2 + y^2 and x y; the module describes x and y.
        ssims: Output, [programs]: sum of SSIM over the values of each Triton program.
        BLOCK: Number of lanes of a Triton program.
    """
    at, _channel, _pixel, row, _column, is_live = place_of(width, height, BLOCK)
    size = 3 * width * height
    mx = window_along_columns(along_rows, at, row, width, height, is_live)
    my = window_along_columns(along_rows + size, at, row, width, height, is_live)
    squares = window_along_columns(along_rows + 2 * size, at, row, width, height, is_live)
    product = window_along_columns(along_rows + 3 * size, at, row, width, height, is_live)
    mean_squares = mx * mx + my * my
    a1, a2 = mx * my * 2.0 + C1, (product - mx * my) * 2.0 + C2
    b1, b2 = mean_squares + C1, squares - mean_squares + C2
    inverse = tl.div_rn(1.0, b1 * b2)
    ssim = a1 * a2 * inverse
    by_b1, by_b2 = ssim * inverse * b2, ssim * inverse * b1
    by_product = a1 * inverse * 2.0
    by_x = my * (a2 * inverse * 2.0 - by_product) - mx * (by_b1 - by_b2) * 2.0
    tl.store(out + at, by_x, is_live)
    tl.store(out + size + at, 0.0 - by_b2, is_live)
    tl.store(out + 2 * size + at, by_product, is_live)
    tl.store(ssims + tl.program_id(0), tl.sum(tl.where(is_live, ssim, 0.0), 0))


@kernel
def derivatives_along_rows(derivatives, width, height, out, BLOCK: tl.constexpr):
    """Apply the SSIM window along rows to the output [3, 3, H, W] of `ssim_derivatives`."""
    at, _channel, _pixel, _row, column, is_live = place_of(width, height, BLOCK)
    size = 3 * width * height
    for image in tl.static_range(3):
        here = derivatives + image * size + at
        value = tl.load(here, is_live, 0.0) * tap(0)
        for k in tl.static_range(1, 6):
            right = tl.load(here + k, is_live & (column + k < width), 0.0)
            left = tl.load(here - k, is_live & (column - k >= 0), 0.0)
            value += (right + left) * tap(k)
        tl.store(out + image * size + at, value, is_live)


@kernel
def color_gradient(
    planes,
    color,
    mask,
    exposure,
    along_rows,
    width,
    height,
    l1,
    d_ssim,
    by_planes,
    l1s,
    squares,
    BLOCK: tl.constexpr,
):
    """Compute the derivatives of the loss with respect to the rendered colors.

    The kernel also sums the absolute and the squared errors.

    Args:
        planes: Rendering, [5, H, W]: red, green, blue, weighted depth, opacity.
        color: Frame, [3, H, W] uint8.
        mask: 0 for ignored pixels, [H, W] uint8.
        exposure: Gains of the three channels, then biases, [2, 3].
        along_rows: Output of `derivatives_along_rows`, [3, 3, H, W].
        width: Width W of the images, pixels.
        height: Height H of the images, pixels.
        l1: Weight of the loss term L1, divided by 3 H W.
        d_ssim: Negative weight of the loss term 1 - SSIM, divided by 3 H W.
        by_planes: Output, [5, H, W]: derivatives with respect to `planes`. This kernel writes those
            of the three colors.
        l1s: Output, [programs]: sum of the absolute errors of each Triton program.
        squares: Output, [programs]: sum of the squared errors of each Triton program.
        BLOCK: Number of lanes of a Triton program.
    """
    at, channel, pixel, row, _column, is_live = place_of(width, height, BLOCK)
    size = 3 * width * height
    # One loop over the three images needs 20 registers fewer than three calls of the window.
    here = along_rows + at
    by_x = tl.load(here, is_live, 0.0) * tap(0)
    by_squares = tl.load(here + size, is_live, 0.0) * tap(0)
    by_product = tl.load(here + 2 * size, is_live, 0.0) * tap(0)
    for k in tl.static_range(1, 6):
        down, is_down = here + k * width, is_live & (row + k < height)
        up, is_up = here - k * width, is_live & (row - k >= 0)
        by_x += (tl.load(down, is_down, 0.0) + tl.load(up, is_up, 0.0)) * tap(k)
        by_squares += (tl.load(down + size, is_down, 0.0) + tl.load(up + size, is_up, 0.0)) * tap(k)
        by_product += (
            tl.load(down + 2 * size, is_down, 0.0) + tl.load(up + 2 * size, is_up, 0.0)
        ) * tap(k)
    x, y, counts, gain = exposed_at(planes, color, mask, exposure, at, channel, pixel, is_live)
    difference = x - y
    by_ssim = by_x + x * 2.0 * by_squares + y * by_product
    gradient = (sign(difference) * l1 + by_ssim * d_ssim) * gain
    tl.store(by_planes + at, tl.where(counts, gradient, 0.0), is_live)
    tl.store(l1s + tl.program_id(0), tl.sum(tl.abs(difference), 0))
    tl.store(squares + tl.program_id(0), tl.sum(difference * difference, 0))


@kernel
def depth_gradient(
    planes, depth_m, mask, width, height, step, by_planes, errors, BLOCK: tl.constexpr
):
    """Compute the derivatives of the loss with respect to the rendered depth and opacity.

    The derivatives with respect to the opacity are 0. The kernel also sums the absolute depth
    errors.

    Args:
        planes: Rendering, [5, H, W]: red, green, blue, weighted depth, opacity.
        depth_m: Depth of the frame, [H, W], meters; 0 where not measured.
        mask: 0 for ignored pixels, [H, W] uint8.
        width: Width W of the images, pixels.
        height: Height H of the images, pixels.
        step: Weight of the depth error, divided by the number of pixels that have a depth and
            are not ignored.
        by_planes: Output, [5, H, W]: derivatives with respect to `planes`. This kernel writes those
            of depth and opacity.
        errors: Output, [programs]: sum of the absolute depth errors of each Triton program.
        BLOCK: Number of lanes of a Triton program.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    size = width * height
    is_live = at < size
    depth = tl.load(depth_m + at, is_live, 0.0)
    counts = is_live & (depth > 0.0) & (tl.load(mask + at, is_live, 0) != 0)
    error = tl.where(counts, tl.load(planes + 3 * size + at, is_live, 0.0) - depth, 0.0)
    tl.store(by_planes + 3 * size + at, sign(error) * step, is_live)
    tl.store(by_planes + 4 * size + at, tl.zeros([BLOCK], tl.float32), is_live)
    tl.store(errors + tl.program_id(0), tl.sum(tl.abs(error), 0))
