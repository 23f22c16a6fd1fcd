"""OpenCV reference implementation of `foreground.surfaces` and `foreground.foreground`."""

from math import exp

import cv2
import numpy as np

from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground, ForegroundConfig, SmoothSurfaces, pixels_of

# Blur before normals are computed; `kernels/smoothness.hpp` gives the reason.
BLUR_PX = 1.5
_3X3 = np.ones((3, 3), np.uint8)


def surfaces_reference(
    depth_m: np.ndarray, camera: Camera, config: ForegroundConfig
) -> SmoothSurfaces:
    """Find pieces of depth [H, W] without steps and creases, connected by the sides of pixels."""
    inverse = _inverse(depth_m)
    low, high = cv2.erode(inverse, _3X3), cv2.dilate(inverse, _3X3)
    smooth = (low > 0) & (high < (1 + config.max_step) * low)
    normals = _normals(cv2.GaussianBlur(inverse, (5, 5), BLUR_PX), camera)
    across = sum(n[:, 4:] * n[:, :-4] for n in normals)
    down = sum(n[4:] * n[:-4] for n in normals)
    smooth[:, 2:-2] &= across > config.min_cosine
    smooth[2:-2] &= down > config.min_cosine
    _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    return SmoothSurfaces(labels, np.bincount(labels.ravel()))


def foreground_reference(
    box: np.ndarray,
    depth_m: np.ndarray,
    found: SmoothSurfaces,
    camera: Camera,
    config: ForegroundConfig,
) -> Foreground:
    """Find the object in a box x0 y0 x1 y1, in pixels.

    The object is at the depth of the middle of the box, on surfaces that lie mostly inside it.
    """
    rows, columns = pixels_of(box, depth_m.shape)
    depth, labels = depth_m[rows, columns], found.labels[rows, columns]
    nothing = Foreground(rows.start, columns.start, np.zeros(depth.shape, bool))
    mode_m = mode_of(depth[_middle(depth.shape)], config.depth_bin) if depth.size else 0.0
    if mode_m == 0:
        return nothing
    reach_m = max(max(depth.shape) * mode_m / min(camera.fx, camera.fy), config.near_mode * mode_m)
    belongs = _inside(labels, found.sizes, config.min_inside)
    belongs &= (depth > 0) & (np.abs(depth - mode_m) < reach_m)
    mask = _grown_from_middle(belongs, depth, mode_m, config)
    return nothing if mask is None else Foreground(rows.start, columns.start, mask)


def mode_of(depth_m: np.ndarray, bin_share: float) -> float:
    """Compute the mode of depths; 0 if no depth is measured.

    The width of a bin is a fraction of its depth, and each bin is smoothed with its neighbors.

    >>> round(mode_of(np.array([0.0, 2.0, 2.01, 2.02, 5.0]), 0.05), 1)
    2.0
    """
    measured = depth_m[(depth_m > 0) & np.isfinite(depth_m)]
    if measured.size == 0:
        return 0.0
    bins = np.floor(np.log(measured) / bin_share).astype(int)
    counts = np.convolve(np.bincount(bins - bins.min()), [1, 2, 1])[1:-1]
    return exp((int(np.argmax(counts)) + int(bins.min()) + 0.5) * bin_share)


def _inverse(depth_m: np.ndarray) -> np.ndarray:
    """Return 1 / depth as float32, 0 where depth is missing."""
    one = np.float32(1)
    return np.where(depth_m > 0, one / np.maximum(depth_m, np.float32(1e-6)), np.float32(0))


def _normals(inverse: np.ndarray, camera: Camera) -> tuple[np.ndarray, ...]:
    """Compute unit normals as images [H, W] float32 of x, y and z.

    Each is the normal of the plane n . p = d through 5x5 pixels, fitted as 1 / z = n . ray / d.
    """
    n_x = cv2.Sobel(inverse, cv2.CV_32F, 1, 0, ksize=5, scale=camera.fx / 128)
    n_y = cv2.Sobel(inverse, cv2.CV_32F, 0, 1, ksize=5, scale=camera.fy / 128)
    u, v = np.arange(camera.width), np.arange(camera.height)[:, None]
    x, y = ((u - camera.cx) / camera.fx), ((v - camera.cy) / camera.fy)
    n_z = inverse - n_x * x.astype(np.float32) - n_y * y.astype(np.float32)
    length = np.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
    inverse_length = np.float32(1) / np.maximum(length, np.float32(1e-9))
    return n_x * inverse_length, n_y * inverse_length, n_z * inverse_length


def _inside(labels: np.ndarray, sizes: np.ndarray, share: float) -> np.ndarray:
    """Return where pixels lie on edges or on surfaces mostly inside the box, [h, w] bool."""
    here = np.bincount(labels.ravel(), minlength=len(sizes))
    is_inside = here >= share * sizes
    is_inside[0] = True  # Edges belong to the adjacent object.
    return is_inside[labels]


def _middle(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of the middle half."""
    height, width = shape
    return slice(height // 4, height - height // 4), slice(width // 4, width - width // 4)


def _grown_from_middle(
    belongs: np.ndarray, depth: np.ndarray, mode_m: float, config: ForegroundConfig
) -> np.ndarray | None:
    """Return the parts of `belongs` with at least a tenth of the near-mode pixels, grown.

    None means that no pixel in the middle is near the mode.
    """
    inverse = _inverse(depth)
    joined = cv2.dilate(inverse, _3X3) <= (1 + config.max_gap) * cv2.erode(inverse, _3X3)
    core = belongs & joined
    count, parts = cv2.connectedComponents(core.astype(np.uint8), connectivity=4)
    seeds, middle = np.zeros(depth.shape, bool), _middle(depth.shape)
    seeds[middle] = (core & (np.abs(depth / mode_m - 1) < config.near_mode))[middle]
    if not np.any(seeds):
        return None
    share = np.bincount(parts[seeds], minlength=count) / np.count_nonzero(seeds)
    mask = (share >= 0.1)[np.asarray(parts, np.int32)]
    for _ in range(config.grow_px):
        beside = cv2.dilate(np.where(mask, depth, 0).astype(np.float32), _3X3)
        mask |= belongs & (beside > 0) & (np.abs(depth - beside) < config.near_mode * beside)
    return mask
