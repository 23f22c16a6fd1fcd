"""Binding of the rasterizer, `kernels/rasterize.hpp`."""

import numpy as np
from numpy.typing import NDArray

def isa() -> str:
    """Return the instruction set of this process: avx512, avx2 or baseline."""

def rasterize(
    rows: NDArray[np.float32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    threads: int = 1,
    memory: Pass | None = None,
    bounds: Bounds | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Render Gaussians for a pinhole camera.

    The function releases the GIL. The result is bitwise equal for any number of threads.
    `ldo_service.gaussians.renderer` describes the fields of the rows and the images.

    Args:
        rows: Gaussians of the map, [N, 16], contiguous.
        T_camera_map: Upper rows of the transform from the map to the camera, [3, 4], contiguous.
        fx: Focal length, pixels.
        fy: Focal length, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        threads: Number of threads.
        memory: Scratch memory to reuse in the next call, which saves up to half of the time of a
            rendering. The previous rendering in this memory is lost.
        bounds: Bounds of the blocks of these rows. Blocks out of view are not read; the images are
            bitwise equal to those without bounds.

    Returns:
        Color [H, W, 3], weighted depth [H, W], median depth [H, W] and opacity [H, W].

    Raises:
        ValueError: An array has the wrong shape, type or strides, the image size or the camera is
            invalid, or another thread uses `memory` or `bounds`.
    """

class Bounds:
    """Bounding volumes of the Gaussians of one array of rows, one per block of 256 rows.

    The owner of the rows must report changed rows before the next rendering, by `forget` or
    `forget_rows`. Rows that were appended, and an array that moved in memory, need no report. Only
    one call at a time may use the bounds.
    """

    def __init__(self) -> None: ...
    def forget(self, first: int = 0, last: int = ...) -> None:
        """Mark rows [first, last) as changed; without arguments, all rows."""

    def forget_rows(self, indices: NDArray[np.uint32]) -> None:
        """Mark the rows `indices` [M] as changed."""

class Pass:
    """Data of one rendering that its gradients need; the next rendering reuses the memory.

    Only one call at a time may use a pass: a second one, from another thread, raises ValueError.
    """

    def __init__(self) -> None: ...
    @property
    def visible(self) -> int:
        """Number V of Gaussians that may touch the last rendered image."""

def contributions(
    forward: Pass,
    indices: NDArray[np.uint32],
    weights: NDArray[np.float32],
    top: NDArray[np.int32],
    threads: int = 1,
) -> None:
    """Compute the contributions of Gaussians to the image last rendered with `forward`.

    The result is bitwise equal for any number of threads.

    Args:
        forward: Pass of the rendering, with V visible Gaussians.
        indices: Output, [V]: row numbers of the visible Gaussians, ascending.
        weights: Output, [V]: weights of these Gaussians, summed over the pixels.
        top: Output, [H, W]: row with the largest weight at each pixel; -1 if no Gaussian has
            weight there. If weights are equal, the nearest Gaussian counts.
        threads: Number of threads.

    Raises:
        ValueError: `forward` holds no rendering or is in use, or an array has the wrong shape, type
            or strides.
    """

def rasterize_planes(
    forward: Pass,
    rows: NDArray[np.float32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    planes: NDArray[np.float32],
    threads: int = 1,
    bounds: Bounds | None = None,
    tiles: NDArray[np.uint8] | None = None,
    binning: int = 1,
) -> int:
    """Render red, green, blue, weighted depth and opacity to planes.

    The function releases the GIL. The result is bitwise equal for any number of threads.

    Args:
        forward: Pass that records the rendering for `backpropagate` and `descend`.
        rows: Gaussians of the map, [N, 16].
        T_camera_map: Upper rows of the transform from the map to the camera, [3, 4].
        fx: Focal length, pixels.
        fy: Focal length, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        planes: Output, [5, H, W].
        threads: Number of threads.
        bounds: Bounds of the blocks of these rows, as for `rasterize`.
        tiles: Tiles to render, [ceil(H / 16), ceil(W / 16)]. The planes of tiles with value 0 are
            zero and are not computed. None renders all tiles.
        binning: Number of full-image pixels along each side of a pixel, 1 or 2. Splats are averaged
            over the pixel.

    Returns:
        The number V of Gaussians that may touch the image.

    Raises:
        ValueError: As for `rasterize`, `tiles` has the wrong shape, type or strides, or `binning`
            is neither 1 nor 2.
    """

def backpropagate(
    forward: Pass,
    rows: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    indices: NDArray[np.uint32],
    row_gradients: NDArray[np.float32],
    needle_weight: float = 0.0,
    needle_log_ratio: float = 0.0,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Compute the derivatives of a loss L by rows and pose, from its derivatives by the planes.

    Args:
        forward: Pass of the last `rasterize_planes`, with V visible Gaussians.
        rows: Rows of that rendering, [N, 16], unchanged.
        planes: Planes of that rendering, [5, H, W], unchanged.
        gradients: Derivatives of L by the planes, [5, H, W].
        indices: Output, [V]: row numbers of the visible Gaussians, ascending.
        row_gradients: Output, [V, 16]: derivatives of L by these rows, with the sum of the
            Gaussian's weights in field 14.
        needle_weight: Weight of the penalty on needle-shaped Gaussians, which is added to L.
        needle_log_ratio: Logarithm of the axis ratio, longest to middle, above which the penalty
            applies.
        threads: Number of threads.

    Returns:
        The derivative of L by xi of T_map_camera exp(xi), [6], rotation first.

    Raises:
        ValueError: `forward` holds no rendering of these rows or is in use, or an array has the
            wrong shape, type or strides.
    """

def descend(
    forward: Pass,
    rows: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    steps: NDArray[np.int32],
    rates: NDArray[np.float32],
    beta1: float,
    beta2: float,
    epsilon: float,
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    indices: NDArray[np.uint32],
    weights: NDArray[np.float32],
    needle_weight: float = 0.0,
    needle_log_ratio: float = 0.0,
    max_sigma_px: float = ...,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Run `backpropagate` and `adam_step` in one pass, which does not store the row gradients.

    `rows`, `mean`, `square` and `steps` change in place, bitwise as if both functions were called.
    Then the standard deviations of changed rows are limited to `max_sigma_px`. The rendering in
    `forward` cannot be differentiated again.

    Args:
        forward: Pass of the last `rasterize_planes`, with V visible Gaussians.
        rows: Rows of that rendering, [N, 16], changed in place.
        mean: First moments of the gradients, [N, 16], changed in place.
        square: Second moments of the gradients, [N, 16], changed in place.
        steps: Number of steps of each row, [N], changed in place.
        rates: Learning rate per field, [16].
        beta1: Decay rate of `mean`, in [0, 1).
        beta2: Decay rate of `square`, in [0, 1).
        epsilon: Positive term that keeps the denominator from zero.
        planes: Planes of that rendering, [5, H, W], unchanged.
        gradients: Derivatives of the loss by the planes, [5, H, W].
        indices: Output, [V]: row numbers of the visible Gaussians, ascending.
        weights: Output, [V]: weights of these Gaussians, summed over the pixels.
        needle_weight: Weight of the penalty on needles, as for `backpropagate`.
        needle_log_ratio: Logarithm of the axis ratio of the penalty, as for `backpropagate`.
        max_sigma_px: Maximum standard deviation in the view, pixels; inf sets no limit.
        threads: Number of threads.

    Returns:
        The derivative of the loss by xi of T_map_camera exp(xi), [6], rotation first.

    Raises:
        ValueError: As for `backpropagate` and `adam_step`.
    """
