"""Adam optimizer of keyframe poses."""

from collections.abc import Mapping

import numpy as np

# Constants of Adam for keyframe poses. A pose gets few steps, so its moments average over more
# steps than those of the Gaussians.
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
WIDTH = 6  # Size of the tangent vector of a pose: rotation, then translation.


class PoseAdam:
    """Adam optimizer of the keyframe poses, with moments for each keyframe."""

    def __init__(self) -> None:
        # First moments, second moments and number of steps of each keyframe, [3, WIDTH].
        self._moments: dict[int, np.ndarray] = {}

    def direction(self, keyframe: int, gradient: np.ndarray) -> np.ndarray:
        """Update the moments of a keyframe, and return the direction of the next step.

        Args:
            keyframe: Id of the keyframe.
            gradient: Derivative of the loss by xi at xi = 0, [6], for the pose T exp(xi). The
                vector xi is a rotation in rad, then a translation in meters.

        Returns:
            Direction, [6]. The step of xi is this direction times the negative learning rates.
        """
        mean, square, steps = self._moments.setdefault(keyframe, np.zeros((3, WIDTH)))
        steps += 1
        mean += (1 - BETA1) * (gradient - mean)
        square += (1 - BETA2) * (gradient * gradient - square)
        return mean / (1 - BETA1**steps) / (np.sqrt(square / (1 - BETA2**steps)) + EPSILON)

    def forget(self, keyframe: int) -> None:
        """Drop the moments of a keyframe."""
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
        moments = state["keyframe_moments"]
        self._moments = dict(zip(keyframes, moments.copy(), strict=True))
