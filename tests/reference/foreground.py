"""The plain twin of `foreground.surfaces` and `foreground.foreground`, by OpenCV."""

from math import exp

import cv2
import numpy as np

from ldo_service.geometry import Camera
from ldo_service.regions.foreground import Foreground, ForegroundConfig, SmoothSurfaces, pixels_of

BLUR_PX = 1.5  # before normals are taken: `kernels/smoothness.hpp` says why
_3X3 = np.ones((3, 3), np.uint8)


def surfaces_reference(
    depth_m: np.ndarray, camera: Camera, config: ForegroundConfig
) -> SmoothSurfaces:
    """Pieces of depth [H, W] without steps and creases, connected by their sides."""
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
    """What is at the depth of the middle, on surfaces that mostly lie in the box x0 y0 x1 y1."""
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
    """The commonest depth, in bins of a share of it, each smoothed with its neighbours; 0 of none.

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
    """1 / depth, float32, 0 where it is missing."""
    one = np.float32(1)
    return np.where(depth_m > 0, one / np.maximum(depth_m, np.float32(1e-6)), np.float32(0))


def _normals(inverse: np.ndarray, camera: Camera) -> tuple[np.ndarray, ...]:
    """Images [H, W] float32 of x, y, z: plane n . p = d through 5x5 pixels, 1 / z = n . ray / d."""
    n_x = cv2.Sobel(inverse, cv2.CV_32F, 1, 0, ksize=5, scale=camera.fx / 128)
    n_y = cv2.Sobel(inverse, cv2.CV_32F, 0, 1, ksize=5, scale=camera.fy / 128)
    u, v = np.arange(camera.width), np.arange(camera.height)[:, None]
    x, y = ((u - camera.cx) / camera.fx), ((v - camera.cy) / camera.fy)
    n_z = inverse - n_x * x.astype(np.float32) - n_y * y.astype(np.float32)
    length = np.sqrt(n_x * n_x + n_y * n_y + n_z * n_z)
    inverse_length = np.float32(1) / np.maximum(length, np.float32(1e-9))
    return n_x * inverse_length, n_y * inverse_length, n_z * inverse_length


def _inside(labels: np.ndarray, sizes: np.ndarray, share: float) -> np.ndarray:
    here = np.bincount(labels.ravel(), minlength=len(sizes))
    is_inside = here >= share * sizes
    is_inside[0] = True  # edges belong to what they are edges of
    return is_inside[labels]


def _middle(shape: tuple[int, ...]) -> tuple[slice, slice]:
    height, width = shape
    return slice(height // 4, height - height // 4), slice(width // 4, width - width // 4)


def _grown_from_middle(
    belongs: np.ndarray, depth: np.ndarray, mode_m: float, config: ForegroundConfig
) -> np.ndarray | None:
    """Of what belongs: what hangs together with a tenth or more of the pixels about the mode."""
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
