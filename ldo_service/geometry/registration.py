"""Registration of images between two cameras. Conventions: `ldo_service.geometry`."""

from functools import lru_cache

import cv2
import numpy as np

from ldo_service.errors import FrameError

from .camera import Camera, project, rays

SAME_SURFACE = 0.05  # Maximum difference of neighboring depths on one surface, fraction of depth.
TIE_PX = 1e-3  # Overlap of neighboring cells, so that float32 rounding leaves no gap.
MAX_STRETCH = 2.0  # Maximum size of a cell relative to its nominal size.
# Maximum area of all cells together, relative to the color image plus the depth image. Cameras that
# belong together reach 1 (measured with random depth and images of 0.05 to 2.8 megapixels).
MAX_COVER = 4.0
# Maximum nominal size of a cell, pixels. A depth image of 80x60 pixels in a 4K image has 48.
MAX_CELL_PX = 64.0


def register_depth(
    depth_m: np.ndarray, depth_camera: Camera, color_camera: Camera, T_color_depth: np.ndarray
) -> np.ndarray:
    """Register a depth image to a color image, which may have lens distortion.

    Each measured depth pixel becomes a rectangle in the color image, called its cell. The cell is
    `fx_color / fx_depth * z_depth / z_color` pixels wide, and its center is

        project_color(T_color_depth @ (ray_depth * depth_m)).

    A cell is stretched halfway to its neighbors on the same surface. The stretching avoids holes
    where the color image is finer than the depth image or the surface is slanted. A color pixel
    gets the smallest depth of all cells that cover it; depth is not interpolated. The result is
    deterministic, because a minimum does not depend on the order of the pixels.

    Args:
        depth_m: Depth, [Hd, Wd], z in meters; 0 where not measured. It has the lens distortion of
            `depth_camera`.
        depth_camera: Intrinsics of the depth image.
        color_camera: Intrinsics of the color image.
        T_color_depth: Transform from depth to color coordinates, [4, 4].

    Returns:
        [Hc, Wc] float32, z in meters in the color camera. Pixels that no cell covers are 0, such as
        surfaces that only the color camera sees. The result has the lens distortion of the color
        camera, so rectify it together with the color image.

    Raises:
        FrameError: The size of the depth image differs from that of `depth_camera`, or the cells
            are too large for the two cameras to belong together.
    """
    if depth_m.shape != (depth_camera.height, depth_camera.width):
        raise FrameError(
            f"depth is {depth_m.shape[1]}x{depth_m.shape[0]} pixels, but its intrinsics are for "
            f"{depth_camera.width}x{depth_camera.height}. Give the intrinsics for this image size."
        )
    cell_px = max(color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy)
    if cell_px > MAX_CELL_PX:
        raise FrameError(
            f"a depth pixel is {cell_px:.0f} color pixels wide, must be at most {MAX_CELL_PX:g}. "
            "Check that each focal length is in pixels of its own image."
        )
    depth_m = np.asarray(depth_m, np.float32)
    x, y, z = _points(depth_m, depth_camera, T_color_depth)
    is_seen = (depth_m > 0) & (z > 0)
    z[~is_seen] = 1.0
    u, v = project(x / z, y / z, color_camera)
    is_seen &= np.isfinite(u)
    u[~is_seen] = v[~is_seen] = 0.0
    scale = np.minimum(depth_m / z, MAX_STRETCH)
    half_u = 0.5 * color_camera.fx / depth_camera.fx * scale
    half_v = 0.5 * color_camera.fy / depth_camera.fy * scale
    is_joined = _same_surface(z, is_seen, 0), _same_surface(z, is_seen, 1)
    columns = _covered(u, half_u, is_joined, 1, color_camera.width)
    rows = _covered(v, half_v, is_joined, 0, color_camera.height)
    return _nearest(z, is_seen, columns, rows, (color_camera.height, color_camera.width))


def _points(
    depth_m: np.ndarray, depth_camera: Camera, T_color_depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of the depth pixels in the frame of the color camera.

    The result is x, y and z in meters, [Hd, Wd] float32 each.
    """
    ray_x, ray_y = rays(depth_camera)
    R, t = T_color_depth[:3, :3].astype(np.float32), T_color_depth[:3, 3].astype(np.float32)
    x, y, z = (
        (R[row, 0] * ray_x + R[row, 1] * ray_y + R[row, 2]) * depth_m + t[row] for row in range(3)
    )
    return x, y, z


def _same_surface(z: np.ndarray, is_seen: np.ndarray, axis: int) -> np.ndarray:
    """Return for each pixel whether this pixel and the next one along `axis` lie on one surface.

    Both must be measured (`is_seen`), and their depths must differ by less than the fraction
    SAME_SURFACE.
    """
    (first, second), (a, b) = _neighbors(z, axis), _neighbors(is_seen, axis)
    return a & b & (np.abs(second - first) < SAME_SURFACE * first)


def _neighbors(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two array views: all pixels but the last along `axis`, and all but the first."""
    return (image[:, :-1], image[:, 1:]) if axis == 1 else (image[:-1], image[1:])


def _covered(
    center: np.ndarray,
    half: np.ndarray,
    is_joined: tuple[np.ndarray, np.ndarray],
    axis: int,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the range of color pixels that each cell covers along one image axis.

    A cell reaches halfway to its neighbors along `axis`. If the projection is sheared, neighbors
    along the other array axis are displaced along `axis` too. The cell therefore also extends by
    half of that displacement.

    Args:
        center: Coordinates of the cell centers along `axis`, [Hd, Wd] pixels.
        half: Half of the nominal size of the cells along `axis`, [Hd, Wd] pixels.
        is_joined: Results of `_same_surface` along array axes 0 and 1.
        axis: Image axis as an array axis: 0 for rows (v), 1 for columns (u).
        size: Size of the color image along `axis`, pixels.

    Returns:
        First and last pixel of each cell, [Hd, Wd] int32, clipped to the image.
    """
    before, after = half.copy(), half.copy()
    along = _half_gap(center, is_joined[axis], axis)
    for reach in (_neighbors(after, axis)[0], _neighbors(before, axis)[1]):
        np.maximum(reach, along, out=reach)
    sheared = np.zeros_like(half)
    across = _half_gap(center, is_joined[1 - axis], 1 - axis)
    for reach in _neighbors(sheared, 1 - axis):
        np.maximum(reach, across, out=reach)
    most = MAX_STRETCH * half
    first = np.ceil(center - np.minimum(before + sheared, most) - TIE_PX)
    last = np.floor(center + np.minimum(after + sheared, most) + TIE_PX)
    return (
        np.clip(first, 0, size).astype(np.int32),
        np.clip(last, -1, size - 1).astype(np.int32),
    )


def _half_gap(center: np.ndarray, is_joined: np.ndarray, axis: int) -> np.ndarray:
    """Return half the distance of neighboring centers along `axis`; 0 at surface boundaries."""
    here, there = _neighbors(center, axis)
    return 0.5 * np.abs(there - here) * is_joined


def _nearest(
    z: np.ndarray,
    is_seen: np.ndarray,
    columns: tuple[np.ndarray, np.ndarray],
    rows: tuple[np.ndarray, np.ndarray],
    shape: tuple[int, int],
) -> np.ndarray:
    """Return the smallest z of the cells that cover each pixel; 0 where no cell does."""
    is_inside = is_seen & (columns[0] <= columns[1]) & (rows[0] <= rows[1])
    _require_bounded(columns, rows, is_inside, shape)
    z, u, last_u, v, last_v = (a[is_inside] for a in (z, *columns, *rows))
    nearest = np.full(shape[0] * shape[1], np.inf, np.float32)
    while len(z):
        _cover_row(nearest, z, v * shape[1] + u, last_u - u)
        more = v < last_v
        z, u, last_u, v, last_v = z[more], u[more], last_u[more], v[more] + 1, last_v[more]
    nearest[np.isinf(nearest)] = 0.0
    return nearest.reshape(shape)


def _require_bounded(
    columns: tuple[np.ndarray, np.ndarray],
    rows: tuple[np.ndarray, np.ndarray],
    is_inside: np.ndarray,
    shape: tuple[int, int],
) -> None:
    """Raise FrameError if the cells cover so many pixels that the cameras do not fit together."""
    wide, high = (1.0 + last - first for first, last in (columns, rows))
    covered = float((wide * high)[is_inside].sum())
    pixels = shape[0] * shape[1] + is_inside.size
    if covered > MAX_COVER * pixels:
        raise FrameError(
            f"the depth pixels cover the color image {covered / (shape[0] * shape[1]):.0f} times, "
            "so the two cameras do not belong together. Check intrinsics, distortion and "
            "T_color_depth of color and depth image."
        )


def _cover_row(nearest: np.ndarray, z: np.ndarray, pixel: np.ndarray, more: np.ndarray) -> None:
    """Lower `nearest` to z at `pixel` and at the `more` pixels to the right of it.

    Args:
        nearest: Least depth of each color pixel so far, [Hc * Wc]; changed in place.
        z: Depths of the cells, [P].
        pixel: Index of the first pixel of each cell in this row, [P].
        more: Number of further pixels of each cell in this row, [P].
    """
    while len(z):
        np.minimum.at(nearest, pixel, z)
        wider = more > 0
        z, pixel, more = z[wider], pixel[wider] + 1, more[wider] - 1


def resample_color(
    color: np.ndarray, color_camera: Camera, depth_camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Resample a color image to the pixels of a depth camera at the same pose.

    To avoid aliasing, the color image is halved until its resolution is at most 1.5 times that of
    the depth image. Then the color image is interpolated bilinearly.

    Args:
        color: Color image, [Hc, Wc, 3] uint8.
        color_camera: Intrinsics of the color image.
        depth_camera: Intrinsics of the depth image.

    Returns:
        The image [Hd, Wd, 3] uint8, and is_seen [Hd, Wd] bool, which is False outside the field of
        view of the color camera.

    Raises:
        FrameError: The size of the color image differs from that of `color_camera`.
    """
    if color.shape[:2] != (color_camera.height, color_camera.width):
        raise FrameError(
            f"color is {color.shape[1]}x{color.shape[0]} pixels, but its intrinsics are for "
            f"{color_camera.width}x{color_camera.height}. Give the intrinsics for this image size."
        )
    while min(color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy) > 1.5:
        color, color_camera = _halved(color), color_camera.halved()
    u, v, is_seen = _color_of_depth_pixels(color_camera, depth_camera)
    image = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return image, is_seen


def resample_labels(labels: np.ndarray, color_camera: Camera, camera: Camera) -> np.ndarray:
    """Resample a label image of the color camera to the pixels of another camera at the same pose.

    Each pixel gets the label of the nearest pixel of the color image.

    Args:
        labels: Labels, [Hc, Wc] uint8 or uint16.
        color_camera: Intrinsics of the label image.
        camera: Intrinsics of the result.

    Returns:
        The labels [H, W]; 0 outside the field of view of the color camera.

    Raises:
        FrameError: The size of the label image differs from that of `color_camera`.
    """
    if labels.shape != (color_camera.height, color_camera.width):
        raise FrameError(
            f"the labels are {labels.shape[1]}x{labels.shape[0]} pixels, but the color image has "
            f"{color_camera.width}x{color_camera.height}. Export the labels at the size of color."
        )
    if camera == color_camera:
        return labels
    u, v, is_seen = _color_of_depth_pixels(color_camera, camera)
    # Ties go to the right and lower pixel; `rint` would alternate between neighbors.
    columns = np.clip(np.floor(np.where(is_seen, u, 0) + 0.5), 0, color_camera.width - 1)
    rows = np.clip(np.floor(np.where(is_seen, v, 0) + 0.5), 0, color_camera.height - 1)
    found = labels[rows.astype(np.intp), columns.astype(np.intp)]
    return np.where(is_seen, found, labels.dtype.type(0))


def _halved(color: np.ndarray) -> np.ndarray:
    height, width = color.shape[0] // 2, color.shape[1] // 2
    return cv2.resize(
        color[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
    )


@lru_cache(maxsize=4)
def _color_of_depth_pixels(
    color_camera: Camera, depth_camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project the depth pixels into the color image.

    Returns:
        u, v [Hd, Wd] float32 in pixels, and which of them are inside the image [Hd, Wd] bool.
    """
    u, v = project(*rays(depth_camera), color_camera)
    width, height = color_camera.width, color_camera.height
    with np.errstate(invalid="ignore"):
        is_seen = (np.abs(u - (width - 1) / 2) <= width / 2) & (
            np.abs(v - (height - 1) / 2) <= height / 2
        )
    return u, v, is_seen
