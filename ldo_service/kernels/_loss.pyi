"""Binding of the image loss, `kernels/loss.hpp`."""

import numpy as np
from numpy.typing import NDArray

def image_loss(
    planes: NDArray[np.float32],
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    mask: NDArray[np.uint8] | None,
    exposure: NDArray[np.float32],
    l1: float,
    d_ssim: float,
    depth_weight: float,
    gradients: NDArray[np.float32],
    threads: int = 1,
) -> tuple[float, float, float, float]:
    """Compute the loss of a rendering, and its derivatives by the planes.

    The function releases the GIL. The result is bitwise equal for any number of threads.
    `ldo_service.gaussians.loss` describes the loss.

    Args:
        planes: Red, green, blue, weighted depth (meters) and opacity, [5, H, W].
        color: Red, green and blue planes of the frame, [3, H, W], 0..255.
        depth: Depth of the frame, [H, W], meters; 0 where not measured.
        mask: Pixels that count, [H, W]; 0 excludes a pixel. None counts all pixels.
        exposure: Gains of the three channels, then biases, [2, 3].
        l1: Weight of L1.
        d_ssim: Weight of D-SSIM.
        depth_weight: Weight of the depth L1.
        gradients: Output, [5, H, W]: derivatives of the weighted loss by the planes.
        threads: Number of threads.

    Returns:
        L1, D-SSIM, depth L1 and squared error: means, without their weights.

    Raises:
        ValueError: An array has the wrong shape, type or strides.
    """
