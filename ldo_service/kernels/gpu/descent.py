"""Derivatives of a rendering with respect to the Gaussians, and a step of Adam."""

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from . import blending, projection_gradient
from .arrays import Arrays
from .plane_rendering import FOUR_WARPS, ROW, TILE, PlaneRendering, programs_for

LANES = 128  # Lanes of the programs, each of which computes one Gaussian.
CORRECTIONS = 1024  # Number of steps after which 1 - beta^steps is 1 in practice.


@dataclass(frozen=True, eq=False, slots=True)
class AdamState:
    """Moments and step counts of N Gaussians on the device, and the constants of Adam.

    Attributes:
        moments: First moments, [N, 16]; changed in place.
        squares: Second moments, [N, 16]; changed in place.
        steps: Number of steps of each row, [N] int32; changed in place.
        corrections: Output of `bias_corrections`, on the device.
        beta1: Decay of the first moments.
        beta2: Decay of the second moments.
        epsilon: Positive term that keeps the denominator from zero.
    """

    moments: Any
    squares: Any
    steps: Any
    corrections: Any
    beta1: float
    beta2: float
    epsilon: float


@dataclass(frozen=True, eq=False, slots=True)
class Derivatives:
    """Derivatives of the loss L with respect to the visible Gaussians and the camera pose.

    Attributes:
        rows: Derivatives with respect to the parameters of the visible Gaussians, [V, 16], on the
            device; undefined after a step of Adam.
        weights: Blending weights of the visible Gaussians, summed over the pixels, [V], on the
            device.
        xi: Derivative with respect to the pose T_map_camera * exp(xi) at xi = 0, [6] float64, on
            the host: rotation (per rad), then translation (per m).
    """

    rows: Any
    weights: Any
    xi: np.ndarray


def bias_corrections(beta1: float, beta2: float) -> np.ndarray:
    """Return the bias corrections of both moments of Adam, [1024, 2] float32.

    Row n contains 1 / (1 - beta^n) for n steps. Row 0 contains 1.
    """
    betas = np.array([beta1, beta2], np.float32).astype(float)
    powers = np.cumprod(np.tile(betas, (CORRECTIONS - 1, 1)), axis=0)
    return np.vstack([np.ones((1, 2)), 1 / (1 - powers)]).astype(np.float32)


def backpropagate(
    arrays: Arrays,
    rows: Any,
    rendering: PlaneRendering,
    by_planes: Any,
    *,
    adam: AdamState | None = None,
    rates: np.ndarray | None = None,
    needle_weight: float = 0.0,
    needle_ratio: float = 1.0,
    max_sigma_px: float = inf,
) -> Derivatives:
    """Differentiate a rendering; if `adam` is given, also take a step of Adam.

    Args:
        arrays: Arrays of the device.
        rows: Parameters of the rendered Gaussians, [N, 16], unchanged since the rendering. A step
            changes them in place.
        rendering: The rendering.
        by_planes: Derivatives of the loss with respect to the planes, [5, H, W].
        adam: State of Adam, which a step changes in place; None to take no step.
        rates: Learning rate of each column of `rows`, [16] float32; needed with `adam`.
        needle_weight: Weight of the penalty on needle-shaped Gaussians; see
            `Rasterizer.gradients`.
        needle_ratio: Ratio of the longest to the middle axis above which the penalty applies.
        max_sigma_px: Largest standard deviation of a Gaussian after a step, in pixels of the
            image.

    Returns:
        The derivatives; `rows` is undefined if `adam` is given.
    """
    lists = rendering.lists
    sums = arrays.zeros((len(lists.listed), ROW), np.float32)
    blending.blend_backward[(len(lists.starts) - 1,)](
        rendering.splats.splats,
        lists.listed,
        lists.reached,
        lists.origins,
        lists.starts,
        rendering.ends,
        -(-rendering.width // TILE),
        rendering.width,
        rendering.height,
        rendering.planes,
        by_planes,
        sums,
        **blending.BACKWARD,
    )
    n = len(lists.visible)
    by_rows = arrays.empty((0 if adam else n, ROW), np.float32)
    weights = arrays.empty((n,), np.float32)
    grid = programs_for(n, LANES)
    by_pose = arrays.empty((*grid, 8), np.float32)
    if n > 0:
        if adam is None:
            unused, no_steps = arrays.empty((1,), np.float32), arrays.empty((1,), np.int32)
            state = (unused, unused, no_steps, unused, unused, 0.0, 0.0, 0.0)
        else:
            state = (
                adam.moments,
                adam.squares,
                adam.steps,
                arrays.upload(np.asarray(rates, np.float32)),
                adam.corrections,
                adam.beta1,
                adam.beta2,
                adam.epsilon,
            )
        projection_gradient.project_backward[grid](
            rows,
            rendering.view,
            rendering.width,
            rendering.height,
            lists.visible,
            n,
            lists.firsts,
            rendering.splats.pairs,
            sums,
            by_rows,
            *state,
            needle_weight,
            float(np.log(needle_ratio)),
            max_sigma_px / rendering.focal_px,
            weights,
            by_pose,
            LAST_STEP=CORRECTIONS - 1,
            ADAM=adam is not None,
            BLOCK=LANES,
            **FOUR_WARPS,
        )
    xi = arrays.download(by_pose).astype(float).sum(axis=0)[:6]
    return Derivatives(by_rows, weights, xi)
