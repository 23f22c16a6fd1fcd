"""Least squares of shared coefficients, with the unknowns of each block eliminated.

A block contains the measurements of one pair of views. Its own unknowns, such as the relative pose
of the pair, occur in no other block. All blocks share the coefficients, such as those of the depth
bias.

Several independent systems of equations are solved at once if the arrays have additional leading
dimensions, written as "...". The color channels are such systems: each channel has its own
coefficients and residuals, and all channels have the same pixels.
"""

from collections.abc import Generator, Sequence, Set
from dataclasses import dataclass

import numpy as np

STUDENT_FREEDOM = 5.0  # Degrees of freedom of the t-distribution of residuals.
GROUPS = 8  # Maximum number of groups of successive blocks; each group is held out once.
MIN_CELL_COUNT = 20  # Cells with at most this many residuals are skipped; their mean is noise.
CLIPPED_SHARE = 0.05  # Fraction of residuals at each end that is clipped before they are averaged.
CHECK_WORK = 0.2  # Work of the check of one block, in the unit of `estimation.estimate`.


@dataclass(frozen=True, slots=True)
class Block:
    """Linearized measurements of one pair of views: residual + J_shared dc + J_own dx.

    dc is the step of the K shared coefficients. dx is the step of the M unknowns that only this
    block has. J_shared [..., N, K] is the Jacobian of the N residuals for dc, and J_own [..., N, M]
    the one for dx.

    Attributes:
        rows: J_shared, J_own and the residual side by side, [..., N, K + M + 1].
        weight: Weight of each squared residual, [..., N].
        cells: Index of the image cell in which each residual lies, [N] int. Cells are squares whose
            side is an eighth of the image width. Empty for features, which `check` skips.
    """

    rows: np.ndarray
    weight: np.ndarray
    cells: np.ndarray

    @property
    def products(self) -> np.ndarray:
        """Weighted sum of the outer products of the N rows, [..., K + M + 1, K + M + 1].

        K is the number of shared coefficients, M that of the block's own unknowns.
        """
        return np.swapaxes(self.rows * self.weight[..., None], -1, -2) @ self.rows


@dataclass(frozen=True, slots=True)
class Reduced:
    """Normal equations of a block after its own unknowns are eliminated (Schur complement).

    The remaining equations are H dc = -g for the step dc of the K shared coefficients. The step dx
    of the M eliminated unknowns follows from dc: dx = -own [dc; 1].
    """

    H: np.ndarray  # [..., K, K]
    g: np.ndarray  # [..., K]
    own: np.ndarray  # [..., M, K + 1]

    @staticmethod
    def of(products: np.ndarray, count: int) -> "Reduced":
        """Eliminate the block's own unknowns.

        Args:
            products: Products of a block, see `Block.products`, or the sum of the products of
                several blocks that have the same own unknowns.
            count: Number K of the shared coefficients.
        """
        K, last = count, products.shape[-1] - 1
        H_own = products[..., K:last, K:last]
        trace = np.trace(H_own, axis1=-2, axis2=-1)[..., None, None]
        H_own = H_own + np.eye(last - K) * (1e-9 * trace + 1e-9)
        columns = [*range(K), last]
        own = np.linalg.solve(H_own, products[..., K:last, columns])
        rest = products[..., :K, columns] - products[..., :K, K:last] @ own
        return Reduced(rest[..., :K], rest[..., K], own)

    def own_step(self, step: np.ndarray) -> np.ndarray:
        """Return the step of the block's own unknowns for a step of the shared coefficients.

        Args:
            step: Step dc of the K shared coefficients, [..., K].

        Returns:
            The step dx of the M own unknowns, [..., M].
        """
        return -(self.own[..., :-1] @ step[..., None])[..., 0] - self.own[..., -1]


@dataclass(frozen=True, slots=True)
class HeldOutResiduals:
    """Residuals of held-out pairs of views, with and without the estimated coefficients.

    Residuals are in meters for depth and in gray levels for color. They are averaged in each cell
    of the image, so that noise averages out. `rms_without` and `rms_with` are root mean squares of
    these averages, in the same unit.
    """

    rms_without: float  # Value with all shared coefficients at 0.
    rms_with: float  # Value with the coefficients estimated from the pairs not held out.

    @property
    def residual_ratio(self) -> float:
        """Ratio of the residuals with and without the estimated coefficients.

        The ratio is `rms_with / rms_without`, or 1 if `rms_without` is 0.
        """
        return self.rms_with / self.rms_without if self.rms_without > 0 else 1.0


def student_weight(residual: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Return weights of residuals for a t-distribution of scale `sigma` (Lange et al., 1989).

    A weight has the unit of 1 / sigma^2.
    """
    sigma = np.asarray(sigma)
    return (STUDENT_FREEDOM + 1) / (STUDENT_FREEDOM + (residual / sigma) ** 2) / sigma**2


def solve(blocks: Sequence[Reduced], prior: np.ndarray | float, now: np.ndarray) -> np.ndarray:
    """Minimize sum weight (residual + J_shared dc + J_own dx)^2 + prior (now + dc)^2 over dc, dx.

    Args:
        blocks: Reduced normal equations.
        prior: Weight of the coefficients: a matrix [K, K], or one weight for all.
        now: Coefficients at which the blocks are linearized, [..., K].

    Returns:
        The step dc of the coefficients, [..., K].
    """
    H = _weights(prior, now)
    g = now @ H
    for block in blocks:
        H, g = H + block.H, g + block.g
    return -np.linalg.solve(H, g[..., None])[..., 0]


def held_out(
    blocks: Sequence[Reduced], prior: float, now: np.ndarray
) -> list[tuple[range, np.ndarray]]:
    """Return groups of successive blocks, each with a step [..., K] of the shared coefficients.

    The step of a group is computed from all blocks that are not in the group.

    Args:
        blocks: Reduced normal equations.
        prior: Weight of the coefficients, the same for all.
        now: Coefficients at which the blocks are linearized, [..., K].
    """
    groups = np.array_split(np.arange(len(blocks)), min(GROUPS, len(blocks)))
    ranges = [range(int(group[0]), int(group[-1]) + 1) for group in groups]
    return [
        (group, solve([*blocks[: group.start], *blocks[group.stop :]], prior, now))
        for group in ranges
    ]


def covariance(
    blocks: Sequence[Reduced],
    prior: np.ndarray | float,
    now: np.ndarray,
    left_out: Sequence[Set[int]],
) -> np.ndarray:
    """Return the covariance [K, K] of the coefficients.

    The result is the sum of two covariances. The first covariance assumes independent residuals and
    includes the prior. The second covariance is a jackknife estimate, and covers errors that many
    residuals have in common.

    Args:
        blocks: Reduced normal equations.
        prior: Weight of the coefficients: a matrix [K, K], or one weight for all.
        now: Coefficients at which the blocks are linearized, [K].
        left_out: Groups of indices of blocks. The jackknife leaves out each group once.
    """
    H = _weights(prior, now) + sum(block.H for block in blocks)
    steps = np.array(
        [
            solve([block for i, block in enumerate(blocks) if i not in group], prior, now)
            for group in left_out
        ]
    )
    apart = steps - steps.mean(axis=0)
    return np.linalg.inv(H) + (len(steps) - 1) / len(steps) * apart.T @ apart


def _weights(prior: np.ndarray | float, now: np.ndarray) -> np.ndarray:
    """Return the weights of coefficients [..., K] as a matrix [K, K]."""
    return np.asarray(prior) if np.ndim(prior) else prior * np.eye(now.shape[-1])


def check(
    blocks: Sequence[Block], reduced: Sequence[Reduced], prior: float, now: np.ndarray
) -> Generator[float, None, list[HeldOutResiduals]]:
    """Compute the residuals of held-out blocks; yield the amount of work after each block.

    Successive blocks form at most GROUPS groups. Each group is held out once, and the coefficients
    are estimated from the blocks of the other groups.

    Args:
        blocks: All blocks.
        reduced: Reduced normal equations of each block.
        prior: Weight of the coefficients, the same for all.
        now: Coefficients at which the blocks are linearized, [..., K].

    Yields:
        The work since the last yield. A unit of work takes about 1 ms on one core.

    Returns:
        The residuals of each independent system, such as a color channel.
    """
    without: list[list[np.ndarray]] = []
    with_: list[list[np.ndarray]] = []
    for group, step in held_out(reduced, prior, now):
        for i in group:
            without.append(_cell_means(blocks[i], -now, reduced[i]))
            with_.append(_cell_means(blocks[i], step, reduced[i]))
            yield CHECK_WORK
    systems = range(len(without[0]))
    return [
        HeldOutResiduals(*(_rms([means[i] for means in each]) for each in (without, with_)))
        for i in systems
    ]


def _cell_means(block: Block, step: np.ndarray, reduced: Reduced) -> list[np.ndarray]:
    """Return the mean residuals of the cells of the image after a step of the coefficients.

    The step of the block's own unknowns follows from the step of the coefficients.

    Returns:
        The means of each independent system.
    """
    steps = np.concatenate([step, reduced.own_step(step), np.ones((*step.shape[:-1], 1))], axis=-1)
    residuals = np.atleast_2d((block.rows @ steps[..., None])[..., 0])
    if not len(block.cells):
        return [np.zeros(0) for _ in residuals]
    count = np.bincount(block.cells)
    is_full = count > MIN_CELL_COUNT
    return [
        np.bincount(block.cells, _clipped(residual))[is_full] / count[is_full]
        for residual in residuals
    ]


def _clipped(residual: np.ndarray) -> np.ndarray:
    """Clip the smallest and the largest residuals [N]."""
    low = int(CLIPPED_SHARE * len(residual))
    high = len(residual) - 1 - low
    ordered = np.partition(residual, (low, high))
    return np.clip(residual, ordered[low], ordered[high])


def _rms(means: Sequence[np.ndarray]) -> float:
    every = np.concatenate(means) if means else np.zeros(0)
    return float(np.sqrt(np.mean(every**2))) if len(every) else 0.0
