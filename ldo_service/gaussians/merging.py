"""Surface that the map holds twice, after a correction has laid one passage over an earlier one."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3


@dataclass(frozen=True, slots=True)
class MergingConfig:
    keyframes_apart: int = 30  # nearer ones see the map that the others made, and add to it
    off_m: float = 0.03  # along the normal: a closure is good to a centimetre or two, and the two
    # sides of a door are 4 cm apart
    reach_sigmas: float = 1.25  # in the plane: the corners of insertion's grid are at 1.18
    min_cosine: float = 0.8  # between normals, 37 deg
    max_color: float = 0.25  # 0..1, in any channel: exposure differs, a picture on a wall stays
    neighbours: int = 4  # older ones that are looked at, the nearest

    def __post_init__(self) -> None:
        if self.keyframes_apart < 1 or self.neighbours < 1:
            raise ConfigError(f"{self}: keyframes_apart and neighbours must be at least 1.")
        if min(self.off_m, self.reach_sigmas, self.max_color) <= 0 or not 0 <= self.min_cosine <= 1:
            raise ConfigError(f"{self}: off_m, reach_sigmas, max_color positive, a cosine 0..1.")


def doubled(
    rows: np.ndarray, anchors: np.ndarray, keyframe: int, config: MergingConfig | None = None
) -> np.ndarray:
    """Mask [N] bool of the Gaussians of `keyframe` that much older ones stand for.

    Such a one lies within `off_m` of an older one's plane and within `reach_sigmas` of it in that
    plane, is turned alike and coloured alike. The older one stays: its neighbours were optimised
    with it for longer, and the closure moved the newer ones.

    rows [N, 16], anchors [N]: see `GaussianMap`. Of the others only those around the keyframe's own
    are looked at, so that it costs the same in a larger map but for one pass over the means.
    """
    config = config or MergingConfig()
    mask = np.zeros(len(rows), bool)
    own = np.flatnonzero(anchors == keyframe)
    reach_m = config.off_m + config.reach_sigmas * _longest_m(rows[own]).max(initial=0)
    older = _within(rows, anchors <= keyframe - config.keyframes_apart, rows[own, :3], reach_m)
    if not len(own) or not len(older):
        return mask
    count = min(config.neighbours, len(older))
    tree = KDTree(rows[older, :3])
    _, found = tree.query(rows[own, :3], k=count)
    for near in np.reshape(found, (len(own), count)).T:
        mask[own] |= _stands_for(rows[older[near]], rows[own], config)
    return mask


def _within(rows: np.ndarray, among: np.ndarray, points: np.ndarray, reach_m: float) -> np.ndarray:
    """Indices of those `among` [N] in the box around points [M, 3], and `reach_m` around that."""
    if not len(points):
        return np.zeros(0, np.intp)
    low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
    candidates = np.flatnonzero(among)
    means = rows[candidates, :3]
    return candidates[np.all((means >= low) & (means <= high), axis=1)]


def _stands_for(older: np.ndarray, newer: np.ndarray, config: MergingConfig) -> np.ndarray:
    """Mask [M] of pairs of rows [M, 16]."""
    normals, others = _normals(older), _normals(newer)
    apart = newer[:, :3] - older[:, :3]
    off_m = np.abs(np.sum(apart * normals, axis=1))
    aside_m = np.sqrt(np.maximum(np.sum(apart**2, axis=1) - off_m**2, 0))
    return (
        (off_m <= config.off_m)
        & (aside_m <= config.reach_sigmas * _longest_m(older))
        & (np.abs(np.sum(normals * others, axis=1)) >= config.min_cosine)
        & (np.abs(older[:, 11:14] - newer[:, 11:14]).max(axis=1) <= config.max_color)
    )


def _normals(rows: np.ndarray) -> np.ndarray:
    """[M, 3] the shortest axis of each."""
    axes = se3.rotation(rows[:, 6:10])
    shortest = np.argmin(rows[:, 3:6], axis=1)
    return np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]


def _longest_m(rows: np.ndarray) -> np.ndarray:
    return np.exp(rows[:, 3:6].max(axis=1, initial=-np.inf))
