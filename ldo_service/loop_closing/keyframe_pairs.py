"""Pairs of a keyframe of an old and a keyframe of a new subgraph, in the order of comparison.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np

from ldo_service.geometry import se3
from ldo_service.tracking.motion import image_motion_rad

from .subgraph import Subgraph, SubgraphKeyframe

# Function of an old and a new keyframe that returns T_old_new [4, 4], or None if it is unknown.
KnownPose = Callable[[SubgraphKeyframe, SubgraphKeyframe], np.ndarray | None]


def distant_pairs(
    old: Subgraph, new: Subgraph, min_gap_frames: int
) -> list[tuple[SubgraphKeyframe, SubgraphKeyframe]]:
    """Return all pairs (old, new) that are more than `min_gap_frames` camera frames apart.

    Frame numbers restart at 0 when the camera restarts, so the old keyframe may have the larger
    frame number.
    """
    return [
        (a, b) for a, b in product(old.views, new.views) if abs(b.frame - a.frame) > min_gap_frames
    ]


def likely_pairs(
    old: Subgraph, new: Subgraph, min_gap_frames: int
) -> Iterator[tuple[SubgraphKeyframe, SubgraphKeyframe]]:
    """Iterate over `distant_pairs`; pairs with the most visual words in common come first."""
    pairs = distant_pairs(old, new, min_gap_frames)
    shared = [float(np.minimum(a.words, b.words).sum()) for a, b in pairs]
    return (pairs[index] for index in np.argsort(-np.array(shared), kind="stable"))


def nearest_pairs(
    old: Subgraph, new: Subgraph, T_old_new: KnownPose, min_gap_frames: int
) -> Iterator[tuple[SubgraphKeyframe, SubgraphKeyframe, np.ndarray]]:
    """Yield each new keyframe with its nearest old one, as (old, new, T_old_new [4, 4]).

    The nearest pairs come first. Pairs without a known relative pose are skipped, and so are pairs
    that are at most `min_gap_frames` camera frames apart.
    """
    nearest = []
    distant = distant_pairs(old, new, min_gap_frames)
    for view in new.views:
        known = [(a, b, T) for a, b in distant if b is view and (T := T_old_new(a, b)) is not None]
        apart = [image_motion_rad(T, a.place.median_depth_m) for a, _, T in known]
        if known:
            index = int(np.argmin(apart))
            nearest.append((apart[index], known[index]))
    for index in np.argsort([apart for apart, _ in nearest], kind="stable"):
        yield nearest[index][1]


def relative_pose(
    old: SubgraphKeyframe, new: SubgraphKeyframe, T_oldodom_newodom: np.ndarray
) -> np.ndarray:
    """Return T_old_new [4, 4] of two keyframes from the transform between their odometry frames."""
    T_odom_old, T_odom_new = old.place.T_odom_keyframe, new.place.T_odom_keyframe
    return se3.orthonormalize(se3.inverse(T_odom_old) @ T_oldodom_newodom @ T_odom_new)
