"""NumPy reference implementation of a step of Adam with a limit on the standard deviations."""

from dataclasses import replace
from math import inf

import numpy as np

from ldo_service.gaussians.renderer import AdamStep

NEAR_M = 0.05  # Smaller depths count as this depth in the limit.


def adam_reference(
    state: AdamStep,
    gradients: np.ndarray,
    T_camera_map: np.ndarray,
    focal_px: float,
    max_sigma_px: float = inf,
) -> AdamStep:
    """Return rows, moments and step counts after a step, in float64.

    Args:
        state: Rows, moments and step counts before the step, and the constants of Adam.
        gradients: Derivatives with respect to the rows, [N, 16]. A row of zeros is hidden and keeps
            its values.
        T_camera_map: Transform from the map to the camera, [4, 4].
        focal_px: Larger focal length, pixels.
        max_sigma_px: Largest standard deviation after the step, in pixels at the depth of the mean.
    """
    is_moved = (np.abs(gradients) > 0).any(axis=1)
    g, beta1, beta2 = gradients[is_moved].astype(float), state.beta1, state.beta2
    steps = state.steps.copy()
    steps[is_moved] += 1
    rows, mean, square = (np.array(x, float) for x in (state.rows, state.mean, state.square))
    mean[is_moved] = beta1 * mean[is_moved] + (1 - beta1) * g
    square[is_moved] = beta2 * square[is_moved] + (1 - beta2) * g**2
    t = steps[is_moved, None]
    unbiased_mean = mean[is_moved] / (1 - beta1**t)
    unbiased_square = square[is_moved] / (1 - beta2**t)
    moved = rows[is_moved]
    moved -= state.rates * unbiased_mean / (np.sqrt(unbiased_square) + state.epsilon)
    z = moved[:, :3] @ T_camera_map[2, :3] + T_camera_map[2, 3]
    limit = np.log(max_sigma_px * np.maximum(z, NEAR_M) / focal_px)
    moved[:, 3:6] = np.minimum(moved[:, 3:6], limit[:, None])
    rows[is_moved] = moved
    return replace(state, rows=rows, mean=mean, square=square, steps=steps)
