"""Adam for the few numbers of each keyframe's pose."""

from collections.abc import Mapping

import numpy as np

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # a view is taken seldom: remember longer than the map
WIDTH = 6  # of a twist


class PoseMoments:
    """First and second moments of the gradients of each keyframe's pose."""

    def __init__(self) -> None:
        self._moments: dict[int, np.ndarray] = {}  # [m, v, steps][WIDTH]

    def direction(self, keyframe: int, gradient: np.ndarray) -> np.ndarray:
        """Adam's step of unit rate [6]."""
        mean, square, steps = self._moments.setdefault(keyframe, np.zeros((3, WIDTH)))
        steps += 1
        mean += (1 - BETA1) * (gradient - mean)
        square += (1 - BETA2) * (gradient * gradient - square)
        return mean / (1 - BETA1**steps) / (np.sqrt(square / (1 - BETA2**steps)) + EPSILON)

    def forget(self, keyframe: int) -> None:
        self._moments.pop(keyframe, None)

    def snapshot(self) -> dict[str, np.ndarray]:
        keyframes = sorted(self._moments)
        moments = [self._moments[k] for k in keyframes]
        return {
            "keyframes": np.array(keyframes, np.int64),
            "keyframe_moments": np.array(moments, float).reshape(-1, 3, WIDTH),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        keyframes = state["keyframes"].tolist()
        moments = state["keyframe_moments"][..., -WIDTH:]  # states of old have exposures before
        self._moments = dict(zip(keyframes, moments.copy(), strict=True))
