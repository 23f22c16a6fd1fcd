"""Shutter timing of a camera and uncertainty of its depth bias, for the tracker."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, slots=True)
class CameraKnowledge:
    """Estimated shutter timing of a camera, and uncertainty of its depth bias.

    The tracker uses the timing to compensate the camera's motion within a frame. It weights depth
    by the uncertainty.
    """

    # Standard deviation of the depth bias, divided by the one of an unknown camera; 0
    # if there is no bias.
    relative_bias_sigma: float = 0.0
    # Normal equations [3, 4] of the times of the shutter: information [3, 3] in 1/s^2, then the
    # right side [3]. Their solution is the estimate, in the order of `ShutterTiming`. None before
    # the first estimate.
    timing: np.ndarray | None = None
