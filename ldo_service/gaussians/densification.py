"""Densification: new Gaussians where a keyframe shows surface that the map lacks.

The image is divided into cells, which are smaller at edges. Each cell becomes one flat Gaussian on
the measured surface.
"""

from dataclasses import replace
from math import inf, log

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame, se3

from .cells import QuadtreeCells, quadtree
from .densification_config import LOW_PASS_COMPENSATION_PX2, DensificationConfig
from .loss import TILE
from .model import GaussianMap
from .renderer import Rasterizer, Rendering, RenderMemory, render
from .rows import ROW


def surfels(
    cells: QuadtreeCells,
    color: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    T_map_camera: np.ndarray,
    *,
    sigma_per_spacing: float,
    thickness: float,
    max_stretch: float,
    opacity: float,
) -> np.ndarray:
    """Return one flat Gaussian per cell, with the cell's mean color and depth, [M, 16] float32.

    Seen from this camera, each Gaussian looks round. In the image, its standard deviation is
    `sigma_per_spacing` times the side of its cell. On a slanted surface, the standard deviation
    down the slope is `1 / cos(angle)` times the standard deviation across the slope. Here `angle`
    is the angle between the normal and the viewing ray. The standard deviation along the normal is
    `thickness` times the standard deviation across the slope.

    Args:
        cells: The cells.
        color: Image, [H, W, 3] uint8.
        depth_m: Depth, [H, W] float32, meters, > 0 in every cell.
        camera: Intrinsics.
        T_map_camera: Camera pose, [4, 4].
        sigma_per_spacing: Standard deviation in the image as a fraction of the cell's side.
        thickness: Standard deviation along the normal as a fraction of that across the slope.
        max_stretch: Upper bound of `1 / cos(angle)`.
        opacity: Opacity of each Gaussian, 0..1.

    Returns:
        Rows as in `gaussians.rows`, one per cell.
    """
    rays = camera.rays_at(cells.u, cells.v)
    z = cells.mean_of(depth_m).astype(float)
    normals = normals_of(cells, rays, z, depth_m, camera)
    axes, cosines = slope_axes(normals, rays)

    sigma_px = np.sqrt((sigma_per_spacing * cells.size) ** 2 - LOW_PASS_COMPENSATION_PX2)
    sigma = sigma_px * z / np.sqrt(camera.fx * camera.fy)
    stretch = np.minimum(1 / np.maximum(cosines, 1e-6), max_stretch)
    rows = np.zeros((len(cells), ROW), np.float32)
    rows[:, 0:3] = se3.transform(T_map_camera, rays * z[:, None])
    rows[:, 3:6] = np.log(np.stack([sigma * stretch, sigma, sigma * thickness], -1))
    rows[:, 6:10] = se3.quaternion(T_map_camera[:3, :3] @ axes)
    rows[:, 10] = log(opacity / (1 - opacity))
    rows[:, 11:14] = cells.mean_of(color) / 255
    return rows


def normals_of(
    cells: QuadtreeCells, rays: np.ndarray, z: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> np.ndarray:
    """Return unit surface normals [M, 3] in the camera frame, pointing away from the camera.

    On a plane n . p = d, the inverse depth is an affine function of the pixel: 1 / z = n . ray / d.
    The gradient of the inverse depth thus gives the normal. The viewing ray is used as the normal
    if the 5x5 pixels around the center of a cell are not one smooth, fully measured surface.

    Args:
        cells: The M cells.
        rays: Viewing rays with z = 1 through the cell centers, [M, 3].
        z: Depths of the cells, [M], meters.
        depth_m: Depth image, [H, W], meters; 0 where not measured.
        camera: Intrinsics.
    """
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-6), 0).astype(np.float32)
    window = np.ones((5, 5), np.uint8)
    low, high = cv2.erode(inverse, window), cv2.dilate(inverse, window)
    middle = tuple(
        _two_from_edges(start + cells.size // 2, length)
        for start, length in zip((cells.row, cells.column), depth_m.shape, strict=True)
    )
    u_slope, v_slope = (
        cv2.Sobel(inverse, cv2.CV_32F, *order, ksize=5, scale=1 / 128)[middle].astype(float)
        for order in ((1, 0), (0, 1))
    )
    n_x, n_y = camera.fx * u_slope, camera.fy * v_slope
    normals = np.stack([n_x, n_y, 1 / z - n_x * rays[:, 0] - n_y * rays[:, 1]], axis=-1)
    smooth = (low[middle] > 0) & (high[middle] < 1.15 * low[middle])
    return _unit(np.where(smooth[:, None], normals, rays))


def slope_axes(normals: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of each surfel and the cosine between its normal and its viewing ray.

    Args:
        normals: Unit normals, [M, 3].
        rays: Viewing rays, [M, 3], in the same frame.

    Returns:
        Rotations [M, 3, 3] and absolute cosines [M] of the angles between normal and ray. The
        columns of a rotation are the directions down the slope, across the slope and along the
        normal.
    """
    unit_rays = _unit(rays)
    cosines = np.sum(normals * unit_rays, axis=1, keepdims=True)
    slope = unit_rays - cosines * normals
    # A surface that faces the camera has no slope, so any direction in its plane works.
    facing = np.linalg.norm(slope, axis=1, keepdims=True) < 1e-3
    x_or_y = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    slope = _unit(np.where(facing, np.cross(normals, x_or_y), slope))
    return np.stack([slope, np.cross(normals, slope), normals], axis=-1), np.abs(cosines[:, 0])


def _two_from_edges(index: np.ndarray, length: int) -> np.ndarray:
    """Clip pixel indices to at least 2 px from both ends of an image side of `length` pixels.

    The 5x5 window around each pixel then lies in the image. On sides below 5 px, where no such
    window fits, the middle pixel is returned.
    """
    return index.clip(min(2, length // 2), max(length - 3, length // 2))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def densify(
    gaussians: GaussianMap,
    frame: RgbdFrame,
    T_map_camera: np.ndarray,
    keyframe: int,
    config: DensificationConfig | None = None,
    *,
    before: Rendering | None = None,
    ignore_mask: np.ndarray | None = None,
    memory: RenderMemory | None = None,
    threads: int = 1,
) -> np.ndarray:
    """Add Gaussians where a keyframe shows surface that the map lacks.

    Existing Gaussians do not change. Equal input gives a bitwise equal result for any number of
    threads.

    Args:
        gaussians: The map; new Gaussians are appended.
        frame: Color and depth of the keyframe. The color must be corrected to the exposure of the
            map.
        T_map_camera: Pose of the keyframe, [4, 4].
        keyframe: Id of the keyframe, to which the new Gaussians are anchored.
        config: Settings.
        before: Rendering of the map at this pose; None to render it here.
        ignore_mask: Ignore mask, [H, W] bool; these pixels get no Gaussians.
        memory: Scratch memory of the renderer; None to allocate it here.
        threads: Threads of the renderer.

    Returns:
        Ids [M] of the new Gaussians.
    """
    config = config or DensificationConfig()
    T_camera_map = se3.inverse(T_map_camera)
    before = before or render(
        gaussians.rows,
        frame.camera,
        T_camera_map,
        bounds=gaussians.bounds,
        memory=memory,
        threads=threads,
    )
    if ignore_mask is not None:
        frame = _without(frame, ignore_mask, before)
    cells, rows = _cells_and_surfels(frame, T_map_camera, before, ignore_mask, config)
    ids = gaussians.add(rows, keyframe)
    rasterizer = Rasterizer(threads=threads, memory=memory)
    _fit_colors(gaussians, cells, frame, T_camera_map, rasterizer, config)
    return ids


def _cells_and_surfels(
    frame: RgbdFrame,
    T_map_camera: np.ndarray,
    before: Rendering,
    ignore_mask: np.ndarray | None,
    config: DensificationConfig,
) -> tuple[QuadtreeCells, np.ndarray]:
    """Return the cells of the surface that the map lacks, and a new Gaussian for each cell.

    Returns:
        M cells, and the rows [M, 16] of their Gaussians.
    """
    depth_m = with_small_holes_filled(frame.depth_m, config.hole_px)
    wanted = densification_mask(frame, before, config) & (depth_m > 0)
    if ignore_mask is not None:
        wanted &= ~ignore_mask
    cells = quadtree(
        frame.color,
        depth_m,
        wanted,
        coarsest_px=config.coarsest_px,
        max_contrast=config.max_contrast,
        max_depth_step=config.max_depth_step,
    )
    rows = surfels(
        cells,
        frame.color,
        depth_m,
        frame.camera,
        T_map_camera,
        sigma_per_spacing=config.sigma_per_spacing,
        thickness=config.thickness,
        max_stretch=config.max_stretch,
        opacity=config.opacity,
    )
    return cells, rows


def _fit_colors(
    gaussians: GaussianMap,
    cells: QuadtreeCells,
    frame: RgbdFrame,
    T_camera_map: np.ndarray,
    rasterizer: Rasterizer,
    config: DensificationConfig,
) -> None:
    """Correct the colors of the newest Gaussians, because overlapping neighbors blur them.

    Args:
        gaussians: The map; its last Gaussians are those of the cells.
        cells: The cells.
        frame: The keyframe.
        T_camera_map: Transform from the map to the camera, [4, 4].
        rasterizer: Renderer of the map.
        config: Settings.
    """
    newest = slice(len(gaussians) - len(cells), None)
    new_colors = gaussians.colors[newest]
    tiles = tiles_of(cells, *frame.depth_m.shape)
    for _ in range(config.color_steps):
        planes = rasterizer.render(
            gaussians.rows, frame.camera, T_camera_map, bounds=gaussians.bounds, tiles=tiles
        )
        shown = np.asarray(cv2.merge([*planes[:3]]))
        correct_colors(new_colors, cells, frame, shown, config.max_color_step)
        gaussians.touch(newest)


def tiles_of(cells: QuadtreeCells, height: int, width: int) -> np.ndarray:
    """Return which tiles of an image contain cells, [ceil(H / 16), ceil(W / 16)] uint8.

    Args:
        cells: The cells. Their places are multiples of their sizes, which are powers of 2.
        height: Height H of the image.
        width: Width W of the image.
    """
    tiles = np.zeros((-(-height // TILE), -(-width // TILE)), np.uint8)
    row, column, across = cells.row // TILE, cells.column // TILE, -(-cells.size // TILE)
    for down in range(across.max(initial=0)):
        for right in range(across.max(initial=0)):
            reaches = across > max(down, right)
            tiles[row[reaches] + down, column[reaches] + right] = 1
    return tiles


def densification_mask(
    frame: RgbdFrame, rendering: Rendering, config: DensificationConfig
) -> np.ndarray:
    """Return the mask of pixels where a keyframe shows surface that the map lacks.

    The mask includes a margin of `overlap_px` pixels around these pixels.

    Args:
        frame: The keyframe, with color corrected to the exposure of the map.
        rendering: Rendering of the map at the pose of the keyframe.
        config: Settings.

    Returns:
        Mask [H, W] bool.
    """
    known = (frame.depth_m > 0) & (rendering.median_depth_m > 0)
    nearer = frame.depth_m < (1 - config.in_front) * nearest_around(
        rendering.median_depth_m, config.edge_px
    )
    out = (1 - rendering.opacity > config.max_transmittance) | (known & nearer)
    if config.max_color_error < 1:
        error = np.abs(_unit_range(frame.color) - rendering.color).mean(axis=-1)
        out |= error > config.max_color_error
    window = np.ones((2 * config.overlap_px + 1,) * 2, np.uint8)
    return cv2.dilate(out.astype(np.uint8), window) > 0


def _without(frame: RgbdFrame, ignore_mask: np.ndarray, before: Rendering) -> RgbdFrame:
    """Return the frame with masked pixels replaced: color by the rendering `before`, depth by 0."""
    shown = (255 * before.color.clip(0, 1) + 0.5).astype(np.uint8)
    color = np.where(ignore_mask[..., None], shown, frame.color)
    return replace(frame, color=color, depth_m=frame.depth_m * ~ignore_mask)


def nearest_around(depth_m: np.ndarray, radius_px: int) -> np.ndarray:
    """Return the least depth [H, W] around each pixel, meters; inf if no depth is measured there.

    The window includes all pixels up to `radius_px` away in each direction.
    """
    window = np.ones((2 * radius_px + 1,) * 2, np.uint8)
    return cv2.erode(np.where(depth_m > 0, depth_m, np.float32(inf)), window)


def with_small_holes_filled(depth_m: np.ndarray, radius_px: int) -> np.ndarray:
    """Return depth [H, W], meters, with small holes filled by the farthest depth around them.

    A pixel without depth is filled only if at least 40 % of the pixels within `radius_px` have
    depth. The farthest of their depths is used, because a hole next to an object is usually
    background that the sensor's projector cannot reach. Without holes, `depth_m` itself is
    returned.
    """
    measured = depth_m > 0
    if measured.all():
        return depth_m
    window = np.ones((2 * radius_px + 1,) * 2, np.uint8)
    counts = cv2.boxFilter(measured.view(np.uint8), cv2.CV_16U, window.shape, normalize=False)
    holes = ~measured & (counts >= 0.4 * window.size)
    return np.where(holes, cv2.dilate(depth_m, window), depth_m)


def correct_colors(
    colors: np.ndarray,
    cells: QuadtreeCells,
    frame: RgbdFrame,
    shown: np.ndarray,
    max_step: float,
) -> None:
    """Add the mean color error of its cell to the color of each new Gaussian.

    The color error is the color of the frame minus that of the rendering. Each channel stays in
    0..1.

    Args:
        colors: Colors of the new Gaussians, [M, 3], 0..1; changed in place.
        cells: The cell of each Gaussian.
        frame: The keyframe.
        shown: Color of the map with the new Gaussians at the pose of the keyframe, [H, W, 3],
            0..1. Pixels outside of the cells may have any color.
        max_step: Largest change of a color channel, 0..1.
    """
    missing = cells.mean_of(_unit_range(frame.color) - shown)
    colors += missing.clip(-max_step, max_step)
    np.clip(colors, 0, 1, out=colors)


def _unit_range(color: np.ndarray) -> np.ndarray:
    return color * np.float32(1 / 255)
