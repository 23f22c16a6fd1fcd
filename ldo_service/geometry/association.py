"""Pairing of two lists of stamps. Conventions: `ldo_service.geometry`."""

import numpy as np


def associate(stamps_a: np.ndarray, stamps_b: np.ndarray, tolerance: float) -> np.ndarray:
    """Index pairs [M, 2] of stamps at most `tolerance` apart, each used once, ascending in a.

    The closest pair is taken first, then the closest of what is left, as TUM's `associate.py`
    does. Both lists may be unsorted; all three arguments share one unit (ns or s).
    """
    candidates = _candidates(stamps_a, stamps_b, tolerance)
    gaps = np.abs(stamps_a[candidates[:, 0]] - stamps_b[candidates[:, 1]])
    free_a, free_b = np.ones(len(stamps_a), bool), np.ones(len(stamps_b), bool)
    pairs = []
    for i, j in candidates[np.argsort(gaps, kind="stable")]:
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), int).reshape(-1, 2)


def _candidates(stamps_a: np.ndarray, stamps_b: np.ndarray, tolerance: float) -> np.ndarray:
    """All index pairs [C, 2] at most `tolerance` apart."""
    order = np.argsort(stamps_b, kind="stable")
    sorted_b = stamps_b[order]
    first = np.searchsorted(sorted_b, stamps_a - tolerance, side="left")
    last = np.searchsorted(sorted_b, stamps_a + tolerance, side="right")
    rows = [(i, j) for i in range(len(stamps_a)) for j in order[first[i] : last[i]]]
    return np.array(rows, int).reshape(-1, 2)
