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
    """One step of Adam, in place, on rows[indices] [M, 16], whose gradients [M, 16] are given.

    Rows with a gradient of zero in every field stay untouched, moments and step count included.
    Releases the GIL. Raises ValueError for arrays that do not fit and indices that do not ascend.
    Bitwise equal for any number of threads.
    """
