"""Observations of objects in a keyframe, and updates of their landmarks: views, votes, merges."""

from dataclasses import dataclass

import numpy as np

from .data_association import MapView
from .label_assignment import HIDDEN
from .object_landmarks import (
    MAX_VOTES,
    NO_MEMBER,
    VIEWS,
    labels_of,
    merged_members,
    reliable_members,
    rows_of,
)


@dataclass(frozen=True, eq=False, slots=True)
class ObservedObject:
    """Observation of an object in a keyframe, or a miss of an object that should be visible.

    Attributes:
        object: Id of the object.
        box: Observed box or, for a miss, the predicted one, [4], x0 y0 x1 y1, pixels.
        distribution: Label distribution of the Gaussians in the region or, for a miss, of the
            object, [C].
        entropy: Entropy of that distribution, nats.
        is_miss: True if the object should have been visible and was not observed.
    """

    object: int
    box: np.ndarray
    distribution: np.ndarray
    entropy: float
    is_miss: bool


@dataclass(frozen=True, slots=True)
class ObjectUpdate:
    """Changes of the objects by a keyframe."""

    observations: tuple[ObservedObject, ...] = ()  # Observations and misses.
    created: tuple[int, ...] = ()  # Ids of new objects.
    # Pairs of a removed id and the id of the object that it was merged into.
    merged: tuple[tuple[int, int], ...] = ()
    removed: tuple[int, ...] = ()  # Ids of objects removed after misses.


def one_each(members: np.ndarray) -> np.ndarray:
    """Return one vote for each member, [K, 256] int8; 0 beyond."""
    return (members != NO_MEMBER).astype(np.int8)


def update_votes(
    votes: np.ndarray, rows: np.ndarray, view: MapView, numbers: np.ndarray
) -> np.ndarray:
    """Return the votes [K, 256] of the members of landmarks after a keyframe.

    Members in the region of their landmark gain a vote. Members that are visible outside of it, or
    not resident, lose one.

    Args:
        votes: Votes before, [K, 256].
        rows: Rows of the members in the map, [K, 256]; -1 if not resident.
        view: The map and the regions of the keyframe.
        numbers: Region of each landmark, [K].
    """
    # Same dtype, else all of `indices` is converted.
    wanted = np.maximum(rows, 0).astype(view.indices.dtype)
    at = np.minimum(np.searchsorted(view.indices, wanted), len(view.indices) - 1)
    is_shown = view.indices[at] == rows
    region = np.where(is_shown, view.regions[at], HIDDEN)
    is_in = region == numbers[:, None]
    is_out = (rows < 0) | ((region != HIDDEN) & ~is_in)
    change = is_in.astype(np.int8) - is_out.astype(np.int8)
    return np.where(votes > 0, np.clip(votes + change, 0, MAX_VOTES), 0).astype(np.int8)


def add_views(table: np.ndarray, keyframe: int, shown: np.ndarray, boxes: np.ndarray) -> None:
    """Add a keyframe to the best views of landmarks.

    The score of a view is the visible fraction `shown` times the square root of the box's area.
    """
    scores = shown * np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))
    add_view(table, np.full(len(table), keyframe), scores, boxes)


def add_view(
    table: np.ndarray, keyframes: np.ndarray, scores: np.ndarray, boxes: np.ndarray
) -> None:
    """Keep the best views of landmarks [K] after adding one to each, in place."""
    all_scores = np.concatenate([table["view_scores"], scores[:, None]], axis=1).astype(np.float32)
    order = np.argsort(-all_scores, axis=1, kind="stable")[:, :VIEWS]
    for name, new in (
        ("view_keyframes", keyframes),
        ("view_scores", scores),
        ("view_boxes", boxes),
    ):
        values = np.concatenate([table[name], np.asarray(new)[:, None]], axis=1)
        at = order.reshape(*order.shape, *[1] * (values.ndim - 2))
        table[name] = np.take_along_axis(values, at, axis=1)


def neighbors(table: np.ndarray, near: np.ndarray, matched: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of landmarks that may be the same object.

    One landmark of a pair is in `matched` and the other is not. They have the same label, and the
    spheres around their boxes meet. Both are numbers of rows of `table` from `near` [K].
    """
    here, is_matched = table[near], np.isin(near, matched)
    name, place = labels_of(here), here["T_map_object"][:, :3, 3]
    reach = np.linalg.norm(here["size"], axis=1) / 2
    one, other = np.nonzero((name[:, None] == name) & is_matched[:, None] & ~is_matched)
    close = np.linalg.norm(place[one] - place[other], axis=1) < reach[one] + reach[other]
    return list(zip(near[one[close]].tolist(), near[other[close]].tolist(), strict=True))


def boxes_overlap(one: np.ndarray, other: np.ndarray, view: MapView, least: float) -> bool:
    """Return whether at least the fraction `least` of one landmark lies in the box of the other.

    It suffices if this holds in one of the two directions.

    Args:
        one: A table of one landmark.
        other: A table of one landmark.
        view: The map with the Gaussians of both.
        least: Minimum fraction of the reliable members.
    """
    shares = (
        inside(other[0], resident_positions(one, view)),
        inside(one[0], resident_positions(other, view)),
    )
    return max(shares) >= least


def merge_into(one: np.ndarray, gone: np.ndarray) -> None:
    """Add the members, counts and views of the landmark `gone` to `one`, both tables [1], in place.

    The caller must derive pose, size and label of `one` again.
    """
    one["members"], one["votes"] = merged_members(
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
    """Return the fraction of points [M, 3] within the box of a landmark; 0 without points."""
    T = landmark["T_map_object"]
    local = (p_map - T[:3, 3]) @ T[:3, :3]
    return (
        float(np.mean(np.all(np.abs(local) <= landmark["size"] / 2, axis=1))) if len(local) else 0
    )


def resident_positions(landmark: np.ndarray, view: MapView) -> np.ndarray:
    """Return the positions [M, 3] of the reliable resident members of a landmark.

    `landmark` is an array with one row of the landmark table.
    """
    where = rows_of(landmark["members"][reliable_members(landmark)], view.ids)
    return view.rows[where[where >= 0], :3].astype(float)
