"""Binding of the search for nearest descriptors, `kernels/matching.hpp`."""

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]

def nearest(
    descriptors: Descriptors,
    candidates: Descriptors,
    index: NDArray[np.int64],
    least: NDArray[np.int32],
    second: NDArray[np.int32],
) -> None:
    """Find the two nearest candidates of each descriptor, by Hamming distance.

    Args:
        descriptors: Descriptors of 256 bits, [N, 32].
        candidates: Descriptors among which the nearest ones are searched, [M, 32], M >= 2.
        index: Output, [N]: the nearest candidate. Of candidates at equal distances, it is the one
            with the lowest index.
        least: Output, [N]: distance of the nearest candidate, bits.
        second: Output, [N]: distance of the second nearest candidate, bits.

    Raises:
        ValueError: An array has the wrong shape, type or strides.
    """
