"""Uncertainty of a camera's depth bias and timing of its shutter, as the tracker uses them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, slots=True)
class CameraKnowledge:
    """Uncertainty of a camera's depth bias, and estimated timing of its shutter.

    The tracker weights depth by the uncertainty, and compensates frames by the timing.
    """

    # Standard deviation of the depth bias, divided by the one of an unknown camera; 0
    # if there is no bias.
    relative_bias_sigma: float = 0.0
    # Normal equations [3, 4] of the times of the shutter: information [3, 3] in 1/s^2, then the
    # right side [3]. Their solution is the estimate, in the order of `ShutterTiming`. None before
    # the first estimate.
    timing: np.ndarray | None = None
