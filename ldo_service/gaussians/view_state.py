"""Adam for the few numbers of each keyframe: its exposure and its pose."""

from collections.abc import Mapping

import numpy as np

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # a view is taken seldom: remember longer than the map
WIDTH = 12  # exposure and pose have 6 numbers each


class ViewMoments:
    """First and second moments of the gradients of each keyframe's exposure and pose."""

    def __init__(self) -> None:
        self._moments: dict[int, np.ndarray] = {}  # [m, v, steps][WIDTH]

    def direction(self, keyframe: int, what: str, gradient: np.ndarray) -> np.ndarray:
        """Adam's step of unit rate, of the gradient's shape (6 numbers)."""
        half = slice(0, 6) if what == "exposure" else slice(6, 12)
        mean, square, steps = self._moments.setdefault(keyframe, np.zeros((3, WIDTH)))[:, half]
        g = gradient.ravel()
        steps += 1
        mean += (1 - BETA1) * (g - mean)
        square += (1 - BETA2) * (g * g - square)
        out = mean / (1 - BETA1**steps) / (np.sqrt(square / (1 - BETA2**steps)) + EPSILON)
        return out.reshape(gradient.shape)

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
        self._moments = dict(zip(keyframes, state["keyframe_moments"].copy(), strict=True))
