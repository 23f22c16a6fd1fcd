"""Binding of the Adam step, `kernels/adam.hpp`."""

import numpy as np
from numpy.typing import NDArray

def adam_step(
    rows: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    steps: NDArray[np.int32],
    indices: NDArray[np.uint32],
    gradients: NDArray[np.float32],
    rates: NDArray[np.float32],
    beta1: float,
    beta2: float,
    epsilon: float,
    threads: int = 1,
) -> None:
    """Apply one step of Adam to the rows `indices`, in place.

    Rows whose gradient is zero in every field keep their values, moments and step counts. The
    function releases the GIL. The result is bitwise equal for any number of threads.

    Args:
        rows: Parameters, [N, 16], changed in place.
        mean: First moments of the gradients, [N, 16], changed in place.
        square: Second moments of the gradients, [N, 16], changed in place.
        steps: Number of steps of each row, [N], changed in place.
        indices: Rows to change, [M], ascending.
        gradients: Gradients of these rows, [M, 16].
        rates: Learning rate per field, [16]; 0 leaves the field unchanged.
        beta1: Decay rate of `mean`, in [0, 1).
        beta2: Decay rate of `square`, in [0, 1).
        epsilon: Positive term that keeps the denominator from zero.
        threads: Number of threads.

    Raises:
        ValueError: An array has the wrong shape, type or strides, indices do not ascend, or a
            number is out of range.
    """
