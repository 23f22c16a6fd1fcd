"""Landmarks that turn out to be one.

Two are if they have the same name and most of one lies in the box of the other, but for those that
one keyframe shows in two regions.
"""

import numpy as np

from .association import MapView
from .landmarks import VIEWS, believed, joined, labels_of, rows_of
from .sightings import add_view


def neighbours(table: np.ndarray, near: np.ndarray, matched: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of one of `near` [K] that was `matched` and one that was not, of the same name, whose
    boxes are close enough to meet."""
    here, is_matched = table[near], np.isin(near, matched)
    name, place = labels_of(here), here["T_map_object"][:, :3, 3]
    reach = np.linalg.norm(here["size"], axis=1) / 2
    one, other = np.nonzero((name[:, None] == name) & is_matched[:, None] & ~is_matched)
    close = np.linalg.norm(place[one] - place[other], axis=1) < reach[one] + reach[other]
    return list(zip(near[one[close]].tolist(), near[other[close]].tolist(), strict=True))


def coincide(one: np.ndarray, other: np.ndarray, view: MapView, least: float) -> bool:
    """Whether that share of one, of two tables [1], lies in the box of the other."""
    shares = inside(other[0], awake(one, view)), inside(one[0], awake(other, view))
    return max(shares) >= least


def absorb(one: np.ndarray, gone: np.ndarray) -> None:
    """Give one landmark what another was, both tables [1], in place; what follows of its members
    is to be derived anew."""
    one["members"], one["votes"] = joined(
        one["members"], one["votes"], gone["members"], gone["votes"]
    )
    for name in ("seen", "last"):
        one[name] = np.maximum(one[name], gone[name])
    for name in ("missed", "misses", "first"):
        one[name] = np.minimum(one[name], gone[name])
    for i in range(VIEWS):
        seen = gone["view_keyframes"][:, i]
        add_view(one, seen, gone["view_scores"][:, i], gone["view_boxes"][:, i])


def inside(landmark: np.ndarray, p_map: np.ndarray) -> float:
    """Share of points [M, 3] within the box of a landmark; 0 of none."""
    T = landmark["T_map_object"]
    local = (p_map - T[:3, 3]) @ T[:3, :3]
    return (
        float(np.mean(np.all(np.abs(local) <= landmark["size"] / 2, axis=1))) if len(local) else 0
    )


def awake(landmark: np.ndarray, view: MapView) -> np.ndarray:
    """Where the Gaussians [M, 3] of one, in a table [1], are."""
    where = rows_of(landmark["members"][believed(landmark)], view.ids)
    return view.rows[where[where >= 0], :3].astype(float)
