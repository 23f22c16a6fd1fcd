"""Binding of surfaces and foregrounds of depth images, `kernels/foreground.hpp`."""

import numpy as np
from numpy.typing import NDArray

def surfaces(
    depth_m: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    max_step: float,
    min_cosine: float,
    labels: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Label the smooth pieces of a depth image.

    Pieces are numbered in the order of their first pixels, row by row. The function releases the
    GIL and runs on one thread. Where a cosine is at its threshold, the result may differ between
    instruction sets. `ldo_service.regions.foreground` describes the method and its settings.

    Args:
        depth_m: Depth, [H, W], meters; missing where it is not above 0.
        fx: Focal length, pixels.
        fy: Focal length, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        max_step: Maximum step of depth within 3x3 pixels of one surface, fraction of depth.
        min_cosine: Minimum cosine of normals 4 px apart on one surface.
        labels: Output, [H, W]: number of the piece that each pixel belongs to; 0 on edges and where
            depth is missing.

    Returns:
        The number of pixels of each label, [S].

    Raises:
        ValueError: An array has the wrong shape, type or strides, or a number is out of range.
    """

def foreground(
    depth_m: NDArray[np.float32],
    focal_px: float,
    labels: NDArray[np.int32],
    sizes: NDArray[np.int64],
    row: int,
    column: int,
    min_inside: float,
    max_gap: float,
    depth_bin: float,
    near_mode: float,
    grow_px: int,
    mask: NDArray[np.uint8],
) -> None:
    """Write the mask of the object in the middle of a window of the image.

    The function releases the GIL and runs on one thread. Where a depth is at the edge of a bin of
    the mode, the result may differ between instruction sets. `ldo_service.regions.foreground`
    describes the method and its settings.

    Args:
        depth_m: Depth, [H, W], meters; missing where it is not above 0.
        focal_px: Focal length, pixels.
        labels: Labels that `surfaces` wrote, [H, W].
        sizes: Sizes that `surfaces` returned, [S].
        row: Row of the window's first pixel.
        column: Column of the window's first pixel.
        min_inside: Minimum fraction of a surface's pixels that lie inside the window.
        max_gap: Maximum step of depth within 3x3 pixels of one object, fraction of depth.
        depth_bin: Width of a bin of the depth mode, fraction of depth.
        near_mode: Maximum distance from the mode, fraction of depth.
        grow_px: Number of pixels by which the mask grows.
        mask: Output of the size of the window, [h, w]: 1 on the object, else 0.

    Raises:
        ValueError: An array has the wrong shape, type or strides, a number is out of range, or the
            window is empty or reaches beyond the image.
    """
