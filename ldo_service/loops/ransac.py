"""The motion that most of many possible correspondences agree on. `ldo_service.geometry`."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import se3
from ldo_service.geometry.se3 import align

SPREAD = 0.1  # m, of three points about their line: below, nothing fixes the turn about it


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """T_a_b [4, 4], and which correspondences [M] agree with it."""

    T_a_b: np.ndarray
    inliers: np.ndarray


def rigid_among(
    p_a: np.ndarray,
    p_b: np.ndarray,
    pairs: np.ndarray,
    limit_m: float,
    iterations: int,
    rng: np.random.Generator,
) -> Motion | None:
    """The motion that most correspondences agree on, by RANSAC over triples of them.

    p_a [K, 3] and p_b [L, 3] m; pairs [M, 2] of indices (a, b) that may belong together: one point
    may be in many, and counts in the nearest alone. None where no triple is a triangle of the same
    shape in both. The winner is fitted again to its inliers.
    """
    best: Motion | None = None
    if len(pairs) < 3:
        return None
    for _ in range(iterations):
        a, b = pairs[rng.choice(len(pairs), 3, replace=False)].T
        if len({*a}) < 3 or len({*b}) < 3 or not _are_alike(p_a[a], p_b[b], limit_m):
            continue
        motion = _supported(p_a, p_b, pairs, align(p_b[b], p_a[a]), limit_m)
        if best is None or motion.inliers.sum() > best.inliers.sum():
            best = motion
    if best is None or best.inliers.sum() < 3:
        return None
    a, b = pairs[best.inliers].T
    return _supported(p_a, p_b, pairs, align(p_b[b], p_a[a]), limit_m)


def _are_alike(p_a: np.ndarray, p_b: np.ndarray, limit_m: float) -> bool:
    """Whether two triangles [3, 3] have the same sides, and are no lines."""
    sides_a, sides_b = (np.linalg.norm(p - np.roll(p, 1, axis=0), axis=1) for p in (p_a, p_b))
    if np.abs(sides_a - sides_b).max() > 2 * limit_m:
        return False
    area = np.linalg.norm(np.cross(p_a[1] - p_a[0], p_a[2] - p_a[0]))
    return bool(area > SPREAD * sides_a.max())


def _supported(
    p_a: np.ndarray, p_b: np.ndarray, pairs: np.ndarray, T_a_b: np.ndarray, limit_m: float
) -> Motion:
    gaps_m = np.linalg.norm(p_a[pairs[:, 0]] - se3.transform(T_a_b, p_b[pairs[:, 1]]), axis=1)
    inliers = np.zeros(len(pairs), bool)
    used: tuple[set[int], set[int]] = set(), set()
    for m in np.argsort(gaps_m, kind="stable"):
        a, b = map(int, pairs[m])
        if gaps_m[m] <= limit_m and a not in used[0] and b not in used[1]:
            inliers[m] = True
            used[0].add(a)
            used[1].add(b)
    return Motion(T_a_b, inliers)
