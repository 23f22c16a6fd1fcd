"""Binding of the angles between normals and viewing rays, `kernels/facing.hpp`."""

import numpy as np
from numpy.typing import NDArray

def facing_cosines(
    depth_m: NDArray[np.float32],
    ray_x: NDArray[np.float64],
    ray_y: NDArray[np.float64],
    mask: NDArray[np.uint8],
    cosines: NDArray[np.float64],
) -> int:
    """Write the absolute cosine between normal and viewing ray of each pixel of a region.

    The pixels are those of the region that have a depth and a normal, row by row. The normal is the
    cross product of the differences of neighboring points. The result is bitwise equal for all
    instruction sets.

    Args:
        depth_m: Depth in a window around the region, [h, w], h >= 2, w >= 2, meters; 0 where
            unknown.
        ray_x: First coordinates of the rays of the columns, [w].
        ray_y: Second coordinates of the rays of the rows, [h]. The third coordinates are 1.
        mask: 1 at the pixels of the region, [h, w].
        cosines: Output, [h w], of which the first values are written.

    Returns:
        Number of written cosines.

    Raises:
        ValueError: An array has the wrong shape, type or strides.
    """
