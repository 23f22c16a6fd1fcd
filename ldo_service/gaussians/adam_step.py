"""What one step of Adam works on, as the kernels take it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, slots=True)
class AdamStep:
    """rows, mean, square  [N, 16] float32: parameters and moments, changed in place
    steps               [N] int32, that each row has made, changed in place
    rates               [16] float32, length of a step per field
    """

    rows: np.ndarray
    mean: np.ndarray
    square: np.ndarray
    steps: np.ndarray
    rates: np.ndarray
    beta1: float
    beta2: float
    epsilon: float
