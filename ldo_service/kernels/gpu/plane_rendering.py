"""Rendering of color, depth and opacity in an iteration of the Gaussian optimizer.

An `Arrays` object allocates the arrays on the device. No kernel uses atomic operations: each Triton
program writes its own sums, and the host adds them in a fixed order. Repeated runs on one GPU model
and one version of Triton therefore give bitwise equal results.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import blending, projection
from .arithmetic import PINNED
from .arrays import Arrays
from .block_means import block_means

TILE = 16  # Pixels.
PLANES = 5  # Red, green, blue, weighted depth, opacity.
ROW = 16  # Floats of a Gaussian, a splat, or the sums of a pair.
LANES = 128  # Lanes of the programs that compute one Gaussian or one pair per lane.
FOUR_WARPS = {"num_warps": 4, **PINNED}
LOW_PASS = np.float32(0.3)  # Variance that the image adds to each splat, px^2.


def view_of(
    T_camera_map: np.ndarray, intrinsics: tuple[float, float, float, float], binning: int = 1
) -> np.ndarray:
    """Return the 18 float32 values of a view; the module `projection` describes their layout.

    Args:
        T_camera_map: Transform from the map to the camera, [4, 4] or [3, 4].
        intrinsics: fx, fy, cx, cy of the rendered image, pixels.
        binning: Width of a pixel of the rendered image in pixels of the full image, 1 or 2.

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
    """Splats, the projections of N Gaussians, and the tiles that they may reach.

    Attributes:
        splats: Splats, [N, 16]; the module `projection` describes the layout.
        ranges: First tile (x0, y0) and last tile (x1, y1) of each splat, both included, [N, 4].
        pairs: Number of tiles of each splat, [N]; 0 if the splat is not drawn.
    """

    splats: Any
    ranges: Any
    pairs: Any


@dataclass(frozen=True, eq=False, slots=True)
class TileLists:
    """P pairs of a splat and a tile that it may reach, sorted by tile, then depth, then row.

    A row is the index of a Gaussian, and of its splat. Before the sort by tile, the pairs of a
    splat are contiguous.

    Attributes:
        visible: Rows of the V drawn splats, [V], ascending.
        firsts: For each row, the index of its first pair before the sort by tile, [N]; undefined
            for rows that are not drawn.
        listed: Row of each pair, [P].
        reached: For each pair, a bit mask of the blocks of 4x4 pixels of the tile that the splat
            may reach, [P].
        origins: Index of each pair before the sort by tile, [P].
        starts: Index of the first pair of each tile, then the number of pairs, [tiles + 1].
    """

    visible: Any
    firsts: Any
    listed: Any
    reached: Any
    origins: Any
    starts: Any


@dataclass(frozen=True, eq=False, slots=True)
class PlaneRendering:
    """Rendered image planes, and everything that their derivatives need.

    Attributes:
        view: Output of `view_of`, on the device.
        focal_px: Larger focal length, max(fx, fy), pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        splats: Projected Gaussians.
        lists: Pairs of a splat and a tile.
        planes: [5, height, width]: red, green, blue, weighted depth, opacity.
        ends: For each block of 4x4 pixels, the index of the pair after the last blended pair,
            [tiles, 16].
    """

    view: Any
    focal_px: float
    width: int
    height: int
    splats: Splats
    lists: TileLists
    planes: Any
    ends: Any


def programs_for(count: int, lanes: int) -> tuple[int]:
    return (-(-count // lanes),)


def project(arrays: Arrays, rows: Any, n: int, view: Any, width: int, height: int) -> Splats:
    """Project the first n Gaussians.

    Args:
        arrays: Arrays of the device.
        rows: Gaussians on the device, [N, 16].
        n: Number of Gaussians, at most N.
        view: Output of `view_of`, on the device.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """
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

    The first sort orders the visible splats by depth. The second sort orders the pairs, which are
    more numerous, by tile. At equal depths, the splat with the lower row index comes first.
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
    """Render the first n Gaussians.

    Args:
        arrays: Arrays of the device.
        rows: Gaussians on the device, [N, 16].
        n: Number of Gaussians, at most N.
        view: Output of `view_of`, on the host.
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
