"""Gaussians that lie close together should be the same thing (paper, III.A).

The kernel is `kernels/consistency.hpp`; its plain twin is `consistency_reference.py`.
"""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.kernels import _labels


@dataclass(frozen=True, slots=True)
class ConsistencyConfig:
    sigma_m: float = 0.05  # sigma_cons (III.A)
    radius_m: float = 0.15  # three sigma: beyond, a weight is below 2e-4
    rate: float = 0.1  # of the step, 0..1: 1 - lambda (III.A), as of one observation

    def __post_init__(self) -> None:
        if not (self.sigma_m > 0 and self.radius_m > 0 and 0 <= self.rate <= 1):
            raise ConfigError(f"{self}: lengths must be positive, rate in 0..1.")


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Before the step, summed over the Gaussians: with k_ij = w_ij exp(-|mu_i - mu_j|^2 / sigma^2)

    literal   sum k_ij [s_i != s_j], as printed; it has no gradient
    expected  sum k_ij (1 - p_i . p_j), which the step makes smaller
    """

    literal: float
    expected: float


def agree(
    rows: np.ndarray,
    labels: np.ndarray,
    indices: np.ndarray,
    config: ConsistencyConfig,
    *,
    threads: int = 1,
) -> Disagreement:
    """A step of the Gaussians `indices` [V] (uint32, ascending) towards their neighbours among
    them, in place.

        p_i <- (1 - rate K_i) p_i + rate sum_j k_ij p_j,  K_i = sum_j k_ij,  w_ij = 1 / |N_i|

    which is along the gradient of the expected disagreement, sum_j k_ij p_j, and keeps a
    distribution. Neighbours: of the first eight Gaussians in the same voxel of two sigma, and the
    first ones of the voxels around it, sixteen together, those within radius_m.

    rows [N, 16] of the map; labels [N, 32]. All read what was before the step. Raises ValueError
    for arrays that do not fit. Bitwise equal for any number of threads.

    Two Gaussians 5 cm apart, a chair (2) and a wall: k = exp(-1), p = 0.1 k = 0.037 apart.

    >>> from .labels import distribution, fields, new_labels
    >>> rows, labels = np.zeros((2, 16), np.float32), new_labels(2)
    >>> rows[1, 0] = 0.05
    >>> fields(labels)["weights"][0, 0], fields(labels)["ids"][0, 0] = 1, 2
    >>> loss = agree(rows, labels, np.arange(2, dtype=np.uint32), ConsistencyConfig())
    >>> round(loss.literal, 3), round(loss.expected, 3)  # both see each other: 2 exp(-1)
    (0.736, 0.736)
    >>> distribution(labels, 3).astype(float).round(3).tolist()
    [[0.037, 0.0, 0.963], [0.963, 0.0, 0.037]]
    """
    lengths = config.sigma_m, config.radius_m
    return Disagreement(*_labels.agree(rows, labels, indices, *lengths, config.rate, threads))
