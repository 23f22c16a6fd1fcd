"""Observations and misses of objects in a keyframe, and the resulting updates of landmarks."""

from dataclasses import dataclass

import numpy as np

from ldo_service.regions.foreground import RegionDetections
from ldo_service.regions.region import Region

from .data_association import MapView, PredictedBoxes
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
from .objects_config import ObjectsConfig


@dataclass(frozen=True, eq=False, slots=True)
class ObservedObject:
    """Observation of an object in a keyframe, or a miss of an object that should be visible.

    Attributes:
        object: Id of the object.
        box: Box of the observed region or, for a miss, the predicted box of the object, [4],
            x0 y0 x1 y1, pixels.
        distribution: Label distribution of the Gaussians in the region or, for a miss, of the
            object, [256].
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
    """Changes of the map's objects that one keyframe causes."""

    observations: tuple[ObservedObject, ...] = ()  # Observations and misses.
    created: tuple[int, ...] = ()  # Ids of new objects.
    # Pairs (removed id, id of the object that it was merged into).
    merged: tuple[tuple[int, int], ...] = ()
    removed: tuple[int, ...] = ()  # Ids of objects removed after misses.


@dataclass(frozen=True, eq=False, slots=True)
class KeyframeSemantics:
    """Result of fusing the detections of a keyframe."""

    keyframe: int
    detections: RegionDetections | None  # The detections as received; None if no detector ran.
    observed: ObjectUpdate  # Changes of the objects.
    requested: tuple[Region, ...] = ()  # Regions to send to the labeller.


def one_each(members: np.ndarray) -> np.ndarray:
    """Return the initial votes of the members of K landmarks, [K, 256] int8.

    A member has one vote at first. An unused entry has no vote.

    Args:
        members: Ids of the sampled Gaussians of each landmark, [K, 256]; NO_MEMBER (-1) in unused
            entries.
    """
    return (members != NO_MEMBER).astype(np.int8)


def update_votes(
    votes: np.ndarray, rows: np.ndarray, view: MapView, numbers: np.ndarray
) -> np.ndarray:
    """Return the votes of the members of K landmarks after a keyframe, [K, 256] int8.

    The members of a landmark are a sample of its Gaussians. A member in the region of its landmark
    gains a vote, up to 8. A member loses a vote if it is visible outside of this region, or if it
    was removed from the map or offloaded to disk. A member with zero votes gains no more votes.

    Args:
        votes: Votes before the keyframe, [K, 256].
        rows: Rows of the members in the map, [K, 256]; -1 if not in memory.
        view: The map and the regions of the keyframe.
        numbers: Number of the region with which each landmark was associated, [K].
    """
    # `searchsorted` would convert all of `indices` if the dtypes differed.
    wanted = np.maximum(rows, 0).astype(view.indices.dtype)
    at = np.minimum(np.searchsorted(view.indices, wanted), len(view.indices) - 1)
    is_shown = view.indices[at] == rows
    region = np.where(is_shown, view.regions[at], HIDDEN)
    is_in = region == numbers[:, None]
    is_out = (rows < 0) | ((region != HIDDEN) & ~is_in)
    change = is_in.astype(np.int8) - is_out.astype(np.int8)
    return np.where(votes > 0, np.clip(votes + change, 0, MAX_VOTES), 0).astype(np.int8)


def add_views(table: np.ndarray, keyframe: int, shown: np.ndarray, boxes: np.ndarray) -> None:
    """Add a view of a keyframe to each of K landmarks, and keep their three best views.

    The score of a view is the visible fraction times the square root of the box's area in pixels.

    Args:
        table: Landmarks, [K] records of `LANDMARK`; changed in place.
        keyframe: Id of the keyframe.
        shown: Visible fraction of each landmark, [K], 0..1.
        boxes: Box of each landmark in the keyframe, [K, 4], x0 y0 x1 y1, pixels.
    """
    scores = shown * np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))
    add_view(table, np.full(len(table), keyframe), scores, boxes)


def add_view(
    table: np.ndarray, keyframes: np.ndarray, scores: np.ndarray, boxes: np.ndarray
) -> None:
    """Add one view to each of K landmarks, and keep the three views with the highest scores.

    Args:
        table: Landmarks, [K] records of `LANDMARK`; changed in place.
        keyframes: Keyframe of the new view of each landmark, [K].
        scores: Scores of the new views, [K]; see `add_views`.
        boxes: Boxes of the landmarks in the new views, [K, 4], x0 y0 x1 y1, pixels.
    """
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


def find_missed(
    table: np.ndarray,
    predicted: PredictedBoxes,
    undetectable: np.ndarray | None,
    config: ObjectsConfig,
) -> np.ndarray:
    """Find landmarks that count as missed in a keyframe if no region was associated with them.

    A landmark counts as missed if it should be visible and the detector knows its label. It also
    counts as missed if the depth camera measured a surface behind the landmark.

    Args:
        table: Landmarks, [K] records of `LANDMARK`.
        predicted: Predicted boxes and visibility of the landmarks in the keyframe.
        undetectable: Labels that the detector does not know, [256] bool. None: the detector knows
            all labels.
        config: Settings of the objects.

    Returns:
        True for each landmark that counts as missed, [K] bool.
    """
    sides = np.clip(predicted.boxes[:, 2:] - predicted.boxes[:, :2], 0, None)
    is_large = np.sqrt(np.prod(sides, axis=1)) >= config.min_side_px
    is_visible = (predicted.shown >= config.min_visible) & is_large
    if undetectable is not None:
        is_visible &= ~undetectable[labels_of(table)]
    return is_visible | (predicted.through >= config.min_visible)


def neighbors(table: np.ndarray, near: np.ndarray, matched: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of landmarks that may be the same object.

    The first landmark of a pair is in `matched`, the second is not. Both have the same label, and
    the spheres around their boxes intersect.

    Args:
        table: All landmarks.
        near: Rows of `table` from which the pairs are formed, [K].
        matched: Rows of `table` that a region was associated with.

    Returns:
        Pairs of rows of `table`.
    """
    here, is_matched = table[near], np.isin(near, matched)
    name, place = labels_of(here), here["T_map_object"][:, :3, 3]
    reach = np.linalg.norm(here["size"], axis=1) / 2
    one, other = np.nonzero((name[:, None] == name) & is_matched[:, None] & ~is_matched)
    close = np.linalg.norm(place[one] - place[other], axis=1) < reach[one] + reach[other]
    return list(zip(near[one[close]].tolist(), near[other[close]].tolist(), strict=True))


def boxes_overlap(one: np.ndarray, other: np.ndarray, view: MapView, least: float) -> bool:
    """Return whether either landmark has enough of its Gaussians in the box of the other.

    The function compares two fractions: the fraction of the Gaussians of `one` in the box of
    `other`, and the fraction of the Gaussians of `other` in the box of `one`. The larger fraction
    must be at least `least`.

    Args:
        one: First landmark, as an array with one record of `LANDMARK`.
        other: Second landmark, in the same format.
        view: The map with the Gaussians of both landmarks.
        least: Minimum fraction, 0..1. It refers to the Gaussians that `resident_positions` returns.
    """
    shares = (
        inside(other[0], resident_positions(one, view)),
        inside(one[0], resident_positions(other, view)),
    )
    return max(shares) >= least


def merge_into(one: np.ndarray, gone: np.ndarray) -> None:
    """Merge members, counts and best views of the landmark `gone` into the landmark `one`.

    Both arguments are arrays with one record of `LANDMARK`; `one` changes in place. The caller must
    then derive pose, size and label of `one` again.
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
    """Return the fraction, 0..1, of points [M, 3] within the box of a landmark; 0 without points.

    The points are in the map frame, in meters.
    """
    T = landmark["T_map_object"]
    local = (p_map - T[:3, 3]) @ T[:3, :3]
    return (
        float(np.mean(np.all(np.abs(local) <= landmark["size"] / 2, axis=1))) if len(local) else 0
    )


def resident_positions(landmark: np.ndarray, view: MapView) -> np.ndarray:
    """Return the positions of a landmark's Gaussians in the map frame, [M, 3], meters.

    The landmark stores a sample of its Gaussians. Of these, only Gaussians in memory with enough
    votes are used; see `reliable_members`. `landmark` is an array with one record of `LANDMARK`.
    """
    where = rows_of(landmark["members"][reliable_members(landmark)], view.ids)
    return view.rows[where[where >= 0], :3].astype(float)
