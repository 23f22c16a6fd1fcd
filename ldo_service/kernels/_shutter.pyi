"""Binding of the compensation of the camera's motion during a frame, `kernels/shutter.hpp`."""

import numpy as np
from numpy.typing import NDArray

def image_motion(
    depth: NDArray[np.float32],
    intrinsics: tuple[float, float, float, float],
    velocity: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Compute the motion of the surface at the centers of cells of 8x8 pixels.

    The function releases the GIL, as `warp` does.

    Args:
        depth: Depth, [H, W] meters; 0 where unknown. The median depth replaces unknown depth.
        intrinsics: Intrinsics (fx, fy, cx, cy), pixels.
        velocity: Velocity of the camera, [6]: rotation in rad/s, then translation in m/s, in the
            camera frame.

    Returns:
        Motion [3, h, w] along u and v in pixels per second, and the relative change of depth per
        second.

    Raises:
        ValueError: An array has the wrong shape, type or strides, or an intrinsic is invalid.
    """

def warp(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    intrinsics: tuple[float, float, float, float],
    velocity: NDArray[np.float64],
    times_s: tuple[float, float, float],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Move pixels and depths to where the camera would have recorded them at one instant.

    The result has the same bits on all instruction sets.

    Args:
        image: Image, [H, W] or [H, W, 3]; a black pixel is missing.
        depth: Depth, [H, W] meters; 0 where unknown.
        intrinsics: Intrinsics (fx, fy, cx, cy), pixels.
        velocity: Velocity of the camera, [6], as in `image_motion`.
        times_s: Readout of color, readout of depth, and delay of depth, seconds.

    Returns:
        The image by bilinear interpolation; it is black where a missing pixel or a pixel outside of
            the image would contribute. Then the depth of the nearest pixel, [H, W] meters, 0 where
            unknown.

    Raises:
        ValueError: An array has the wrong shape, type or strides, or an intrinsic is invalid.
    """
