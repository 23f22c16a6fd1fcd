"""Launches of the kernels of an optimizer iteration: rendering, loss, and a step of Adam.

Arrays of the device come from an `Arrays`. No kernel uses atomic operations: each program writes
its own values, and the host adds sums of programs in a fixed order. The results are therefore
bitwise equal on one GPU model and one version of Triton.
"""

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from . import blending, loss, projection
from .arithmetic import PINNED
from .arrays import Arrays
from .block_means import block_means
from .projection_gradient import project_backward

TILE = 16  # Pixels.
PLANES = 5  # Red, green, blue, weighted depth, opacity.
ROW = 16  # Floats of a Gaussian, a splat, or the sums of a pair.
LANES = 128  # Lanes of the programs that compute one Gaussian or one pair per lane.
PIXEL_LANES = 256  # Lanes of the programs that compute one pixel value per lane.
FOUR_WARPS = {"num_warps": 4, **PINNED}
CORRECTIONS = 1024  # Number of steps after which 1 - beta^steps is 1 in practice.
LOW_PASS = np.float32(0.3)  # Variance that the image adds to each splat, px^2.
MAX_LIMIT = 1e30  # A limit on sizes that no Gaussian reaches; infinity would become NaN.


def view_of(
    T_camera_map: np.ndarray, intrinsics: tuple[float, float, float, float], binning: int = 1
) -> np.ndarray:
    """Return the values [18] float32 that kernels need of a view.

    Args:
        T_camera_map: [4, 4] or [3, 4].
        intrinsics: fx, fy, cx, cy of the rendered image, pixels.
        binning: Number of full-image pixels along each side of a pixel, 1 or 2.

    Raises:
        ValueError: `binning` is neither 1 nor 2.
    """
    if binning not in (1, 2):
        raise ValueError(f"binning is {binning}, must be 1 or 2.")
    box = np.float32((1 - 1 / binning**2) / 12)  # A box of width b has the variance b^2 / 12.
    low_pass = np.float32(1 / binning**2) * LOW_PASS + box
    T = np.asarray(T_camera_map)[:3].reshape(-1)
    return np.array([*T, *intrinsics, low_pass, box], np.float32)


@dataclass(frozen=True, eq=False, slots=True)
class Splats:
    """Projection of N Gaussians.

    Attributes:
        splats: [N, 16].
        ranges: Tiles x0 y0 x1 y1 of each splat, [N, 4].
        pairs: Number of tiles of each splat, [N]; 0 if it is not drawn.
    """

    splats: Any
    ranges: Any
    pairs: Any


@dataclass(frozen=True, eq=False, slots=True)
class TileLists:
    """Pairs of a splat and a tile, sorted by (tile, depth, row).

    Attributes:
        visible: Rows that are drawn, [V], ascending.
        firsts: First pair of each row in the order before the sort by tile, [N]; undefined for rows
            that are not drawn.
        listed: Splat of each pair, [P].
        reached: Blocks that each pair reaches, [P].
        origins: Place of each pair before the sort by tile, [P].
        starts: First pair of each tile, [tiles + 1].
    """

    visible: Any
    firsts: Any
    listed: Any
    reached: Any
    origins: Any
    starts: Any


@dataclass(frozen=True, eq=False, slots=True)
class PlaneRendering:
    """Rendered planes, and everything that their derivatives need.

    Attributes:
        view: View, [18].
        focal_px: Larger focal length.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        splats: Projected Gaussians.
        lists: Pairs of splats and tiles.
        planes: [5, height, width].
        ends: Pair after the last one that each block blended, [tiles, 16].
    """

    view: Any
    focal_px: float
    width: int
    height: int
    splats: Splats
    lists: TileLists
    planes: Any
    ends: Any


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """Images of a keyframe on the device.

    Attributes:
        color: [3, H, W] uint8.
        depth_m: [H, W] float32; 0 where not measured.
        mask: [H, W] uint8, 0 where the pixel is ignored.
        measured: Number of depths that count.
    """

    color: Any
    depth_m: Any
    mask: Any
    measured: int


@dataclass(frozen=True, eq=False, slots=True)
class AdamState:
    """Moments and step counts of N Gaussians on the device, and the constants of Adam.

    Attributes:
        moments: First moments, [N, 16]; changed in place.
        squares: Second moments, [N, 16]; changed in place.
        steps: Number of steps of each row, [N] int32; changed in place.
        corrections: Output of `bias_corrections`, on the device.
        beta1: Decay of the first moments.
        beta2: Decay of the second moments.
        epsilon: Positive term that keeps the denominator from zero.
    """

    moments: Any
    squares: Any
    steps: Any
    corrections: Any
    beta1: float
    beta2: float
    epsilon: float


@dataclass(frozen=True, eq=False, slots=True)
class Derivatives:
    """Derivatives of the loss on the device, and the derivative by the pose on the host.

    Attributes:
        rows: Derivatives by the visible rows, [V, 16]; undefined after a step of Adam.
        weights: Blending weights of the visible rows summed over the pixels, [V].
        xi: dL/dxi at xi = 0 of T_map_camera exp(xi), [6] float64: rotation rad, translation m.
    """

    rows: Any
    weights: Any
    xi: np.ndarray


def bias_corrections(beta1: float, beta2: float) -> np.ndarray:
    """Return 1 / (1 - beta^steps) of both moments by the number of steps, [1024, 2] float32."""
    betas = np.array([beta1, beta2], np.float32).astype(float)
    powers = np.cumprod(np.tile(betas, (CORRECTIONS - 1, 1)), axis=0)
    return np.vstack([np.ones((1, 2)), 1 / (1 - powers)]).astype(np.float32)


def programs_for(count: int, lanes: int) -> tuple[int]:
    return (-(-count // lanes),)


def project(arrays: Arrays, rows: Any, n: int, view: Any, width: int, height: int) -> Splats:
    """Project the first n rows."""
    out = Splats(
        arrays.empty((n, ROW), np.float32),
        arrays.empty((n, 4), np.int32),
        arrays.empty((n,), np.int32),
    )
    if n > 0:
        projection.project_and_cull[programs_for(n, LANES)](
            rows,
            n,
            view,
            width,
            height,
            out.splats,
            out.ranges,
            out.pairs,
            BLOCK=LANES,
            **FOUR_WARPS,
        )
    return out


def list_tiles(arrays: Arrays, splats: Splats, width: int, height: int) -> TileLists:
    """List the pairs of splats and tiles, in two stable sorts.

    The visible splats are sorted by depth, and then the more numerous pairs by tile. At equal
    depths, the lower row comes first.
    """
    columns, tile_rows = -(-width // TILE), -(-height // TILE)
    visible = arrays.nonzero(splats.pairs)
    n_visible = len(visible)
    keys = arrays.empty((n_visible,), np.int32)
    if n_visible > 0:
        projection.depth_keys[programs_for(n_visible, LANES)](
            splats.splats, visible, n_visible, keys, BLOCK=LANES, **FOUR_WARPS
        )
    by_depth = arrays.take(visible, arrays.stable_order(keys))
    counts = arrays.take(splats.pairs, by_depth)
    offsets, n_pairs = arrays.offsets(counts)
    firsts = arrays.empty((len(splats.pairs),), np.int32)
    arrays.put(firsts, by_depth, offsets)
    owners = arrays.repeat(by_depth, counts, n_pairs)
    tiles, reached = (arrays.empty((n_pairs,), np.int32) for _ in range(2))
    if n_pairs > 0:
        projection.list_pairs[programs_for(n_pairs, LANES)](
            splats.splats,
            splats.ranges,
            owners,
            firsts,
            n_pairs,
            columns,
            tiles,
            reached,
            BLOCK=LANES,
            **FOUR_WARPS,
        )
    origins = arrays.stable_order(tiles)
    starts = arrays.starts(arrays.take(tiles, origins), columns * tile_rows)
    listed, reached = arrays.take(owners, origins), arrays.take(reached, origins)
    return TileLists(visible, firsts, listed, reached, origins, starts)


def render(
    arrays: Arrays, rows: Any, n: int, view: np.ndarray, width: int, height: int
) -> PlaneRendering:
    """Render the first n rows.

    Args:
        arrays: Arrays of the device.
        rows: Gaussians on the device, [N, 16].
        n: Number of Gaussians, at most N.
        view: Output of `view_of`.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """
    on_device = arrays.upload(view)
    splats = project(arrays, rows, n, on_device, width, height)
    lists = list_tiles(arrays, splats, width, height)
    planes = arrays.empty((PLANES, height, width), np.float32)
    tiles = len(lists.starts) - 1
    ends = arrays.empty((tiles, 16), np.int32)
    blending.blend_forward[(tiles,)](
        splats.splats,
        lists.listed,
        lists.reached,
        lists.starts,
        -(-width // TILE),
        width,
        height,
        planes,
        ends,
        **blending.ONE_WARP,
    )
    focal_px = float(max(view[12], view[13]))
    return PlaneRendering(on_device, focal_px, width, height, splats, lists, planes, ends)


def mean_blocks(arrays: Arrays, rendering: PlaneRendering, side: int) -> np.ndarray:
    """Average color and opacity of a rendering over complete blocks of side x side pixels.

    Returns:
        Red, green, blue and opacity, [4, height // side, width // side] float32.
    """
    across, down = rendering.width // side, rendering.height // side
    out = arrays.empty((4, down, across), np.float32)
    if across * down > 0:
        block_means[(4 * across * down,)](
            rendering.planes,
            rendering.width,
            rendering.height,
            side,
            across,
            down,
            out,
            LANES=1 << (side * side - 1).bit_length(),
            **blending.ONE_WARP,
        )
    return arrays.download(out)


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
        frame: Images of the same size.
        exposure: Gains of the three channels, then biases, [2, 3] float32.
        weights: Weights of L1, D-SSIM and depth.

    Returns:
        dL/dplanes [5, H, W] on the device. Then L1, D-SSIM, depth error and squared error as means,
        [4] float64.
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
    loss.means_along_rows[grid](*seen, width, height, along, **options)
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


def backpropagate(
    arrays: Arrays,
    rows: Any,
    rendering: PlaneRendering,
    by_planes: Any,
    *,
    adam: AdamState | None = None,
    rates: np.ndarray | None = None,
    needle_weight: float = 0.0,
    needle_ratio: float = 1.0,
    max_sigma_px: float = inf,
) -> Derivatives:
    """Differentiate a rendering; with `adam`, take a step instead of returning the derivatives.

    Args:
        arrays: Arrays of the device.
        rows: Rows of the rendering, unchanged since then; a step changes them in place.
        rendering: The rendering.
        by_planes: Derivatives of the loss by the planes, [5, H, W].
        adam: State of Adam, which changes in place.
        rates: Learning rate of each column, [16] float32; needed with `adam`.
        needle_weight: Weight of the penalty on needles; see `Rasterizer.gradients`.
        needle_ratio: Ratio of the longest to the middle axis above which the penalty applies.
        max_sigma_px: Limit on the standard deviations after a step, in pixels of the image.
    """
    lists = rendering.lists
    sums = arrays.zeros((len(lists.listed), ROW), np.float32)
    blending.blend_backward[(len(lists.starts) - 1,)](
        rendering.splats.splats,
        lists.listed,
        lists.reached,
        lists.origins,
        lists.starts,
        rendering.ends,
        -(-rendering.width // TILE),
        rendering.width,
        rendering.height,
        rendering.planes,
        by_planes,
        sums,
        **blending.BACKWARD,
    )
    n = len(lists.visible)
    by_rows = arrays.empty((0 if adam else n, ROW), np.float32)
    weights = arrays.empty((n,), np.float32)
    grid = programs_for(n, LANES)
    by_pose = arrays.empty((*grid, 8), np.float32)
    if n > 0:
        if adam is None:
            unused, no_steps = arrays.empty((1,), np.float32), arrays.empty((1,), np.int32)
            state = (unused, unused, no_steps, unused, unused, 0.0, 0.0, 0.0)
        else:
            state = (
                adam.moments,
                adam.squares,
                adam.steps,
                arrays.upload(np.asarray(rates, np.float32)),
                adam.corrections,
                adam.beta1,
                adam.beta2,
                adam.epsilon,
            )
        project_backward[grid](
            rows,
            rendering.view,
            rendering.width,
            rendering.height,
            lists.visible,
            n,
            lists.firsts,
            rendering.splats.pairs,
            sums,
            by_rows,
            *state,
            needle_weight,
            float(np.log(needle_ratio)),
            min(max_sigma_px / rendering.focal_px, MAX_LIMIT),
            weights,
            by_pose,
            LAST_STEP=CORRECTIONS - 1,
            ADAM=adam is not None,
            BLOCK=LANES,
            **FOUR_WARPS,
        )
    xi = arrays.download(by_pose).astype(float).sum(axis=0)[:6]
    return Derivatives(by_rows, weights, xi)
