"""Pruning of Gaussians that are transparent, oversized, hidden or duplicates.

Duplicates arise if the same surface was mapped twice at different poses. A correction of the pose
graph then moves both copies to the same pose.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3


@dataclass(frozen=True, slots=True)
class PruningConfig:
    """Criteria of the pruning."""

    min_opacity: float = 0.005  # Kerbl et al., 2023, sec. 5.2.
    # Largest length of a Gaussian's longest axis, relative to the mean longest axis of the other
    # Gaussians in its neighborhood (LDO-SLAM paper, III.A).
    max_relative_scale: float = 10.0
    neighborhood_m: float = 0.25  # Edge of the cubes of space that are the neighborhoods.
    # A Gaussian must be visible in the image of its anchor keyframe or of the newest keyframe.
    # This is checked when this many keyframes have followed the anchor keyframe, and later at
    # random. Hidden Gaussians are removed, because other Gaussians have grown over them.
    confirm_keyframes: int = 5
    # Least sum of a visible Gaussian's blending weights over an image; 0 turns the check off. In
    # the sequence kitchen, the map has 430 k Gaussians without the check and 165 k with the check;
    # the PSNR of held-out views differs by 0.1 dB. With 1 instead of 0.25, maps have 22 to 31 %
    # fewer Gaussians at the same PSNR, but small objects in images of 128x96 pixels shrink.
    min_weight_px: float = 0.25

    def __post_init__(self) -> None:
        if not 0 <= self.min_opacity < 1:
            raise ConfigError(named(self, "min_opacity") + " must lie in [0, 1).")
        if self.confirm_keyframes < 1 or not self.min_weight_px >= 0:
            raise ConfigError(
                named(self, "confirm_keyframes", "min_weight_px")
                + ": confirm_keyframes must be at least 1, and min_weight_px at least 0."
            )
        if not (self.max_relative_scale > 1 and self.neighborhood_m > 0):
            raise ConfigError(
                named(self, "max_relative_scale", "neighborhood_m")
                + ": max_relative_scale must exceed 1, and neighborhood_m must be positive."
            )


def prunable_mask(rows: np.ndarray, config: PruningConfig | None = None) -> np.ndarray:
    """Return the mask of Gaussians that are nearly transparent, oversized or not finite.

    A Gaussian is oversized if its longest axis exceeds `max_relative_scale` times the mean longest
    axis of the other Gaussians in its cube of edge `neighborhood_m`.

    Args:
        rows: Gaussians, [N, 16]; see `GaussianMap`.
        config: Criteria.

    Returns:
        Mask [N] bool.
    """
    config = config or PruningConfig()
    finite = np.isfinite(rows[:, :14]).all(axis=1)
    max_m = np.exp(rows[:, 3:6].max(axis=1).astype(float))
    transparent = rows[:, 10] < np.log(config.min_opacity / (1 - config.min_opacity))
    mean_m = _mean_around(rows[:, :3], np.where(finite, max_m, 0), config.neighborhood_m)
    return transparent | ~finite | (max_m > config.max_relative_scale * mean_m)


def _mean_around(means: np.ndarray, values: np.ndarray, edge_m: float) -> np.ndarray:
    """Return, for each Gaussian, the mean value of the other Gaussians in the same cube, [N].

    Space is divided into cubes of edge `edge_m`. The mean is infinite if no other Gaussian is in
    the cube.
    """
    cube = np.floor(np.nan_to_num(means.astype(float)) / edge_m).astype(np.int64)
    cube -= cube.min(axis=0, initial=0)
    sizes = cube.max(axis=0, initial=0) + 1
    key = (cube[:, 0] * sizes[1] + cube[:, 1]) * sizes[2] + cube[:, 2]
    _, group = np.unique(key, return_inverse=True)
    others = np.bincount(group)[group] - 1
    total = np.bincount(group, values)[group] - values
    return np.where(others > 0, total / np.maximum(others, 1), np.inf)


def weights(rows: np.ndarray) -> np.ndarray:
    """Return the approximate contribution [N] of each Gaussian in `rows` [N, 16] to an image.

    The contribution is the opacity times the product of the two largest standard deviations, m^2.
    """
    log_scales = rows[:, 3:6]
    return _opacities(rows) * np.exp(log_scales.sum(axis=1) - log_scales.min(axis=1))


def weightiest(rows: np.ndarray, most: int) -> np.ndarray:
    """Return the mask [N] bool of the `most` rows with the largest `weights`; all if N <= most."""
    mask = np.ones(len(rows), bool)
    if len(rows) > most:
        mask[np.argsort(weights(rows), kind="stable")[: len(rows) - most]] = False
    return mask


def _opacities(rows: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-rows[:, 10]))


@dataclass(frozen=True, slots=True)
class DeduplicationConfig:
    """Criteria of duplicate Gaussians."""

    # Least difference between the ids of the two anchor keyframes. When a keyframe was mapped, the
    # Gaussians of the keyframes just before it were in view, so it added no duplicates of them.
    keyframes_apart: int = 30
    # Largest distance along the normal of the older Gaussian. A loop closure is accurate to one or
    # two centimeters, and the two sides of a door are 4 cm apart.
    off_m: float = 0.03
    # Largest distance in the plane of the older Gaussian, relative to its longest standard
    # deviation. The corners of a densification cell are 1.18 standard deviations from the center.
    reach_sigmas: float = 1.25
    min_cosine: float = 0.8  # Least |cos| of the angle between the normals: 37 deg.
    # Largest difference in any color channel, 0..1. It allows for different exposures, but does not
    # take a picture on a wall for a duplicate of the wall.
    max_color: float = 0.25
    neighbors: int = 4  # Number of nearest older Gaussians that each Gaussian is compared with.

    def __post_init__(self) -> None:
        if self.keyframes_apart < 1 or self.neighbors < 1:
            raise ConfigError(named(self, "keyframes_apart", "neighbors") + " must be at least 1.")
        if min(self.off_m, self.reach_sigmas, self.max_color) <= 0 or not 0 <= self.min_cosine <= 1:
            raise ConfigError(
                named(self, "off_m", "reach_sigmas", "min_cosine", "max_color")
                + ": off_m, reach_sigmas and max_color must be positive, and min_cosine must lie "
                "in 0..1."
            )


def find_duplicates(
    rows: np.ndarray, anchors: np.ndarray, keyframe: int, config: DeduplicationConfig | None = None
) -> np.ndarray:
    """Return the mask of the Gaussians of a keyframe that duplicate much older Gaussians.

    A duplicate lies within `off_m` of the plane of an older, flat Gaussian. Along that plane, it
    lies within `reach_sigmas` standard deviations of the center of the older Gaussian. Both have
    similar normals and colors. The older Gaussian is not in the mask, since it was optimized longer
    together with its neighbors.

    Only Gaussians near those of the keyframe are compared. Apart from one pass over all means, the
    computing time does not grow with the map.

    Args:
        rows: Gaussians, [N, 16]; see `GaussianMap`.
        anchors: Ids of the anchor keyframes, [N].
        keyframe: Id of the keyframe.
        config: Criteria.

    Returns:
        Mask [N] bool.
    """
    config = config or DeduplicationConfig()
    mask = np.zeros(len(rows), bool)
    own = np.flatnonzero(anchors == keyframe)
    reach_m = config.off_m + config.reach_sigmas * _max_m(rows[own]).max(initial=0)
    older = _within(rows, anchors <= keyframe - config.keyframes_apart, rows[own, :3], reach_m)
    if not len(own) or not len(older):
        return mask
    count = min(config.neighbors, len(older))
    tree = KDTree(rows[older, :3])
    _, found = tree.query(rows[own, :3], k=count)
    for near in np.reshape(found, (len(own), count)).T:
        mask[own] |= _is_duplicate(rows[older[near]], rows[own], config)
    return mask


def _within(rows: np.ndarray, among: np.ndarray, points: np.ndarray, reach_m: float) -> np.ndarray:
    """Return the indices of the rows near some points, where the mask `among` [N] is True.

    Near means inside the bounding box of the points [M, 3], enlarged by `reach_m` on all sides.
    """
    if not len(points):
        return np.zeros(0, np.intp)
    low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
    candidates = np.flatnonzero(among)
    means = rows[candidates, :3]
    return candidates[np.all((means >= low) & (means <= high), axis=1)]


def _is_duplicate(older: np.ndarray, newer: np.ndarray, config: DeduplicationConfig) -> np.ndarray:
    """Return which pairs are duplicates, [M] bool; pair m is row m of `older` and `newer`."""
    normals, others = _normals(older), _normals(newer)
    apart = newer[:, :3] - older[:, :3]
    off_m = np.abs(np.sum(apart * normals, axis=1))
    aside_m = np.sqrt(np.maximum(np.sum(apart**2, axis=1) - off_m**2, 0))
    return (
        (off_m <= config.off_m)
        & (aside_m <= config.reach_sigmas * _max_m(older))
        & (np.abs(np.sum(normals * others, axis=1)) >= config.min_cosine)
        & (np.abs(older[:, 11:14] - newer[:, 11:14]).max(axis=1) <= config.max_color)
    )


def _normals(rows: np.ndarray) -> np.ndarray:
    """Return the unit vector along the shortest axis of each Gaussian, [M, 3]."""
    axes = se3.rotation(rows[:, 6:10])
    shortest = np.argmin(rows[:, 3:6], axis=1)
    return np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]


def _max_m(rows: np.ndarray) -> np.ndarray:
    return np.exp(rows[:, 3:6].max(axis=1, initial=-np.inf))
