"""A measured pose of one keyframe in another."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Measured T_a_b [4, 4] with its information [6, 6]: rotation, then translation, at b."""

    a: int
    b: int
    T_a_b: np.ndarray
    information: np.ndarray
