"""The depth errors of a first-generation Kinect."""

import numpy as np

# Khoshelham and Elberink, Sensors 2012: depth is 1 / (step * disparity), with disparity in whole
# steps, so a step in depth is 2.85e-3 z^2 m; the matching errs by half a step.
DISPARITY_STEP_PER_M = 2.85e-3
DISPARITY_SIGMA_STEPS = 0.5
NEAREST_M, FARTHEST_M = 0.4, 8.0


def kinect_depth(depth_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Depth [H, W] in metres as a Kinect measures it; 0 outside its range and beside outlines.

    The error grows with the square of depth: 3 mm steps at 1 m, 26 mm at 3 m.
    """
    disparity = 1 / (depth_m * DISPARITY_STEP_PER_M)
    disparity = disparity + DISPARITY_SIGMA_STEPS * rng.standard_normal(depth_m.shape)
    measured = 1 / (np.maximum(np.floor(disparity + 0.5), 1.0) * DISPARITY_STEP_PER_M)
    seen = (measured >= NEAREST_M) & (measured <= FARTHEST_M) & ~_is_shadowed(depth_m)
    return np.where(seen, measured, 0.0)


def _is_shadowed(depth_m: np.ndarray) -> np.ndarray:
    """The far side [H, W] of a jump in depth along the row, which the projector does not reach."""
    jump = np.diff(depth_m, axis=1, prepend=depth_m[:, :1])
    return jump > 0.05 * depth_m
