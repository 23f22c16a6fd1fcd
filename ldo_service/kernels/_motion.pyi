"""Binding of the motion of Gaussians, `kernels/motion.hpp`."""

import numpy as np
from numpy.typing import NDArray

def move_rows(
    rows: NDArray[np.float32],
    anchors: NDArray[np.int32],
    keyframes: NDArray[np.int64],
    T_new_old: NDArray[np.float64],
    quaternions: NDArray[np.float64],
    threads: int = 1,
) -> None:
    """Move Gaussians in place by the transforms of their anchor keyframes.

    The function releases the GIL. The result is bitwise equal for any number of threads.

    Args:
        rows: Gaussians, [N, 16].
        anchors: Anchor keyframe of each Gaussian, [N].
        keyframes: Ids of the moved keyframes, [K], ascending. Other Gaussians stay.
        T_new_old: Transforms of these keyframes, [K, 4, 4].
        quaternions: Rotations of these transforms, [K, 4] wxyz.
        threads: Number of threads.

    Raises:
        ValueError: An array has the wrong shape, type or strides, or keyframes do not ascend.
    """
