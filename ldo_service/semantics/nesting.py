"""What lies on a larger thing is no part of it: a cup in the box of its table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError

from .foreground import Foreground


@dataclass(frozen=True, slots=True)
class NestingConfig:
    """Two regions of which one lies in the other are no rivals: both may be there. As rivals, by
    score, a table of 0.9 would win the pixels of a cup of 0.5."""

    inside: float = 0.8  # share of the smaller one, to lie in the larger
    times: float = 2.0  # as large: less, and they are of one thing
    least_score: float = 0.5  # of the smaller: many boxes below are wrong

    def __post_init__(self) -> None:
        if not (0 < self.inside <= 1 and self.times > 1 and self.least_score >= 0):
            raise ConfigError(
                f"{self}: inside within 0..1, times over 1, least_score not negative."
            )


def without_nested(
    parts: Sequence[Foreground], scores: np.ndarray, config: NestingConfig
) -> list[Foreground]:
    """Each of M parts but for the pixels of those that lie in it; scores [M].

    >>> table = Foreground(0, 0, np.ones((4, 8), bool))
    >>> cup = Foreground(1, 2, np.ones((2, 2), bool))
    >>> left, whole = without_nested([table, cup], np.array([0.9, 0.5]), NestingConfig())
    >>> int(left.mask.sum()), int(whole.mask.sum())
    (28, 4)
    """
    sizes = [np.count_nonzero(part.mask) for part in parts]
    left = [part.mask for part in parts]
    for i in np.flatnonzero(np.asarray(scores) >= config.least_score).tolist():
        for k in range(len(parts)):
            if 0 < config.times * sizes[i] <= sizes[k] and (both := _shared(parts[i], parts[k])):
                of_small, of_large = both
                shared = parts[i].mask[of_small] & parts[k].mask[of_large]
                if np.count_nonzero(shared) >= config.inside * sizes[i]:
                    left[k] = left[k].copy()
                    left[k][of_large] &= ~shared
    return [Foreground(p.row, p.column, mask) for p, mask in zip(parts, left, strict=True)]


Window = tuple[slice, slice]


def _shared(a: Foreground, b: Foreground) -> tuple[Window, Window] | None:
    """The window that the masks of both have, in each; None where they have none."""
    top, left = max(a.row, b.row), max(a.column, b.column)
    bottom = min(a.row + a.mask.shape[0], b.row + b.mask.shape[0])
    right = min(a.column + a.mask.shape[1], b.column + b.mask.shape[1])
    if top >= bottom or left >= right:
        return None
    of_a, of_b = (
        (slice(top - p.row, bottom - p.row), slice(left - p.column, right - p.column))
        for p in (a, b)
    )
    return of_a, of_b
