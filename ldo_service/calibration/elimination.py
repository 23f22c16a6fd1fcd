"""Least squares of shared coefficients, with the unknowns of each block eliminated.

A block contains the measurements of one pair of views. The unknowns of a block, such as the
relative pose, occur in no other block. The coefficients are shared by all blocks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STUDENT_FREEDOM = 5.0  # Degrees of freedom of the t-distribution of residuals.
GROUPS = 8  # Maximum number of groups of successive blocks; each group is held out once.
MIN_CELL_COUNT = 20  # Cells with at most this many residuals are skipped; their mean is noise.
CELL_QUANTILES = (5, 95)  # Percentiles to which residuals are clipped before they are averaged.


@dataclass(frozen=True, slots=True)
class Block:
    """Linearized measurements of one pair of views: residual + shared dc + own dx.

    dc is the step of the shared coefficients, dx that of the unknowns of this block.
    """

    shared: np.ndarray  # [N, K] derivative with respect to the shared coefficients.
    own: np.ndarray  # [N, M] derivative with respect to the unknowns of this block.
    residual: np.ndarray  # [N]
    weight: np.ndarray  # [N]
    cells: np.ndarray  # [C] int: cell of the image for each of the first C residuals, C <= N.


@dataclass(frozen=True, slots=True)
class Solution:
    """Step of the shared coefficients, with its evaluation on held-out blocks."""

    step: np.ndarray  # [K]
    own_steps: list[np.ndarray]  # [M] for each block.
    sigma: np.ndarray  # [K] standard deviation by jackknife over the groups of blocks.
    # Root mean square of the cells' mean residuals in held-out blocks. `rms_without` has all shared
    # coefficients at 0; `rms_with` uses the coefficients estimated from the other groups. Within a
    # cell, noise averages out.
    rms_without: float
    rms_with: float

    @property
    def residual_ratio(self) -> float:
        """Ratio rms_with / rms_without of the held-out residuals; 1 if rms_without is 0."""
        return self.rms_with / self.rms_without if self.rms_without > 0 else 1.0


def student_weight(residual: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Return the weights 1/variance of residuals with a t-distribution (Lange et al., 1989)."""
    sigma = np.asarray(sigma)
    return (STUDENT_FREEDOM + 1) / (STUDENT_FREEDOM + (residual / sigma) ** 2) / sigma**2


def solve(blocks: Sequence[Block], prior: float, now: np.ndarray) -> Solution:
    """Minimize the sum of weight (residual + shared dc + own dx)^2, plus prior |now + dc|^2.

    Args:
        blocks: Measurements in the order of time.
        prior: Weight of the coefficients.
        now: Coefficients at which the blocks are linearized, [K].
    """
    reduced = [_reduced(block) for block in blocks]
    count = len(now)

    def step_of(chosen: Sequence[int]) -> np.ndarray:
        H, g = prior * np.eye(count), prior * now
        for i in chosen:
            H, g = H + reduced[i][0], g + reduced[i][1]
        return -np.linalg.solve(H, g)

    every = range(len(blocks))
    step = step_of(every)
    groups = np.array_split(np.arange(len(blocks)), min(GROUPS, len(blocks)))
    without, with_ = [], []
    steps = []
    for group in groups:
        left_out = set(group.tolist())
        steps.append(step_of([i for i in every if i not in left_out]))
        for i in left_out:
            without.append(_cell_means(blocks[i], -now, reduced[i][2]))
            with_.append(_cell_means(blocks[i], steps[-1], reduced[i][2]))
    sigma = np.sqrt((len(groups) - 1) * np.var(steps, axis=0))
    own = [-(K @ np.r_[step, 1.0]) for _, _, K in reduced]
    return Solution(step, own, sigma, _rms(without), _rms(with_))


def _reduced(block: Block) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eliminate the block's own unknowns from its normal equations.

    Returns:
        H [K, K] and g [K] of the shared coefficients, and G [M, K + 1]. The step of the block's own
        unknowns is -G [dc; 1].
    """
    shared, own = block.shared * block.weight[:, None], block.own * block.weight[:, None]
    H_shared, H_mixed, H_own = block.shared.T @ shared, shared.T @ block.own, block.own.T @ own
    H_own = H_own + np.eye(len(H_own)) * (1e-9 * np.trace(H_own) + 1e-9)
    g_shared, g_own = shared.T @ block.residual, own.T @ block.residual
    G = np.linalg.solve(H_own, np.c_[H_mixed.T, g_own])
    return H_shared - H_mixed @ G[:, :-1], g_shared - H_mixed @ G[:, -1], G


def _cell_means(block: Block, step: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return the mean residual of each cell of the image after a step of the coefficients.

    The block's own unknowns take the step that follows from it by G (see `_reduced`).
    """
    if not len(block.cells):
        return np.zeros(0)
    own_step = -(G @ np.r_[step, 1.0])
    residual = block.residual + block.shared @ step + block.own @ own_step
    residual = residual[: len(block.cells)]
    clipped = np.clip(residual, *np.percentile(residual, CELL_QUANTILES))
    count, total = np.bincount(block.cells), np.bincount(block.cells, clipped)
    is_full = count > MIN_CELL_COUNT
    return total[is_full] / count[is_full]


def _rms(means: list[np.ndarray]) -> float:
    every = np.concatenate(means) if means else np.zeros(0)
    return float(np.sqrt(np.mean(every**2))) if len(every) else 0.0
