"""Table of object landmarks, each with a sample of the Gaussians of one object.

The members of a landmark are at most 256 of its Gaussians. The landmark stores the id and the votes
of each member. A member gains votes in keyframes that show it in the region of the object. It loses
votes in keyframes that show it outside of this region.

A fixed rule shuffles the ids of Gaussians, and the first 256 in this order are the members. The
members are therefore a uniform sample, independent of the order in which Gaussians were added. The
position and label of a landmark are derived from the members, and change when the map changes.
"""

import numpy as np

from ldo_service.geometry import Camera

from .distributions import KEPT, dense, entropy, mean_distributions, sparse
from .gaussian_labels import BACKGROUND

# Maximum members per landmark. The centroid of 256 samples has a standard error of 1/16 of the
# object's spread.
MEMBERS = 256
VIEWS = 3  # Best views that are stored.
NO_MEMBER = -1
# Maximum votes of a member. A wrong member loses one per keyframe and is removed after at most 8.
MAX_VOTES = 8
TRIM = 0.02  # Fraction of the members at each end of an axis that counts as outliers of the box.
_AT_A_TIME = 128  # Landmarks per batch of `derive_in_batches`, to stay in cache.

LANDMARK = np.dtype(
    [
        ("id", "<i8"),  # Id of the object for other programs; -1 for a candidate.
        ("seen", "<i4"),  # Number of keyframes that observed the object.
        ("missed", "<i4"),  # Number of keyframes that should have observed the object and did not.
        ("misses", "<i4"),  # Misses in a row since the last observation.
        ("first", "<i8"),  # First and last keyframe that observed the object.
        ("last", "<i8"),
        ("anchor", "<i8"),  # Anchor keyframe of most members.
        ("centroid", "<f8", 3),  # m, map frame.
        ("covariance", "<f8", (3, 3)),  # m^2
        ("T_map_object", "<f8", (4, 4)),  # Center and axes of the object's box.
        ("size", "<f8", 3),  # Extents of the box along its axes, m.
        # Sparse label distribution: probabilities of `labels`, the highest first.
        ("weights", "<f4", KEPT),
        ("labels", "u1", KEPT),
        ("members", "<i8", MEMBERS),  # Ids of Gaussians in shuffled order, then NO_MEMBER.
        ("votes", "i1", MEMBERS),  # Votes of the members; see `observations.update_votes`.
        ("view_keyframes", "<i8", VIEWS),  # Keyframes of the best views, best first; -1 for none.
        ("view_scores", "<f4", VIEWS),
        ("view_boxes", "<f4", (VIEWS, 4)),  # x0 y0 x1 y1, pixels.
    ]
)


def new_landmarks(n: int, keyframe: int) -> np.ndarray:
    """Return records of n new candidate objects without Gaussians, first observed in `keyframe`."""
    table = np.zeros(n, LANDMARK)
    table["id"] = table["view_keyframes"] = NO_MEMBER
    table["members"], table["T_map_object"] = NO_MEMBER, np.eye(4)
    table["first"] = table["last"] = table["anchor"] = keyframe
    return table


def distributions(table: np.ndarray) -> np.ndarray:
    """Return the dense label distributions [K, 256] of K records of `LANDMARK`."""
    return dense(table["labels"], table["weights"])


def labels_of(table: np.ndarray) -> np.ndarray:
    """Return the most probable label of each landmark, [K] uint8; background is left out.

    `table` has K records of `LANDMARK`, whose labels are sorted by probability.
    """
    first = table["labels"][:, 0]
    return np.where(first == BACKGROUND, table["labels"][:, 1], first)


def entropies(table: np.ndarray) -> np.ndarray:
    """Return the entropies [K], nats, of the label distributions of K records of `LANDMARK`."""
    return entropy(distributions(table))


# --- members --------------------------------------------------------------------------------------
def shuffled(ids: np.ndarray) -> np.ndarray:
    """Return a sort key for each id, [...] uint64, that shuffles the ids by a fixed rule.

    Different ids have different keys. NO_MEMBER (-1), which marks an unused entry, has the largest
    key. The key is the id times a constant odd number, modulo 2^64. The constant is derived from
    the golden ratio, so that the keys of consecutive ids are far apart.
    """
    places = ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return np.where(ids == NO_MEMBER, np.uint64(2**64 - 1), places)


def merged_members(
    members: np.ndarray, votes: np.ndarray, others: np.ndarray, other_votes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Merge two lists of members for each of K landmarks.

    Members are ids of Gaussians. The members of the first list that have zero votes are removed
    first. A member that is then in both lists keeps its votes from the first list. If there are
    more than 256 members, the first 256 in the order of `shuffled` are kept.

    Args:
        members: Ids of the first list, [K, M].
        votes: Votes of the first list, [K, M].
        others: Ids of the second list, [K, L].
        other_votes: Votes of the second list, [K, L].

    Returns:
        Ids of the members, [K, 256], and their votes, [K, 256] int8.
    """
    both = np.concatenate([np.where(votes > 0, members, NO_MEMBER), others], axis=1)
    counts = np.concatenate([votes, other_votes], axis=1)
    both, counts = _in_order(both, counts)
    both[:, 1:][both[:, 1:] == both[:, :-1]] = NO_MEMBER
    both, counts = _in_order(both, counts)
    return both[:, :MEMBERS], np.where(both >= 0, counts, 0)[:, :MEMBERS].astype(np.int8)


def _in_order(ids: np.ndarray, votes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(shuffled(ids), axis=1, kind="stable")
    return np.take_along_axis(ids, order, axis=1), np.take_along_axis(votes, order, axis=1)


def reliable_members(table: np.ndarray) -> np.ndarray:
    """Return which members of K landmarks are reliable, [K, 256] bool.

    The members of a landmark are at most 256 of its Gaussians, and each member has a vote count. A
    member is reliable if its count is at least a third of the highest count in the landmark.
    Gaussians next to an object get few votes, because the edges of regions vary between keyframes.

    Args:
        table: Landmarks, [K] records of `LANDMARK`.
    """
    return (table["votes"] > 0) & (3 * table["votes"] >= table["votes"].max(axis=1, keepdims=True))


def rows_of(members: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Return the row of each member in the arrays of the map, [...]; -1 if it is not in memory.

    The members of a landmark are a sample of its Gaussians.

    Args:
        members: Ids of the members, [...].
        ids: Ids of the Gaussians of the map, [N], ascending.
    """
    if len(ids) == 0:
        return np.full(members.shape, -1)
    # The search is four times faster if queries are sorted, because it reads neighboring entries.
    order = np.argsort(members, axis=None)
    at = np.empty(members.size, np.int64)
    at[order] = np.searchsorted(ids, members.ravel()[order])
    at = np.minimum(at, len(ids) - 1).reshape(members.shape)
    return np.where(ids[at] == members, at, -1)


# --- derived values -------------------------------------------------------------------------------
def derive(
    table: np.ndarray,
    rows: np.ndarray,
    labels: np.ndarray,
    ids: np.ndarray,
    anchors: np.ndarray,
    least: int,
) -> None:
    """Derive pose, size, label and anchor keyframe of K landmarks from the map, in place.

    The values come from the members of a landmark, a sample of its Gaussians. Members are used if
    they have enough votes (see `reliable_members`) and are in memory rather than on disk. Landmarks
    with fewer than `least` such members stay unchanged.

    Args:
        table: Landmarks, [K] records of `LANDMARK`.
        rows: Gaussians of the map, [N, 16].
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        ids: Ids of the Gaussians, [N], ascending.
        anchors: Anchor keyframes of the Gaussians, [N].
        least: Minimum number of members that are used.
    """
    where = np.where(reliable_members(table), rows_of(table["members"], ids), -1)
    known = np.flatnonzero(np.count_nonzero(where >= 0, axis=1) >= max(least, 1))
    if len(known) == 0:
        return
    where = where[known]
    weights = _opacities(rows, where)
    p_map = rows[np.maximum(where, 0), :3].astype(float)
    spread = moments(p_map, weights)
    T_map_object, size = boxes(p_map, weights > 0, spread[1])
    label_ids, label_weights = sparse(mean_distributions(labels[np.maximum(where, 0)], weights))
    for name, values in {
        "centroid": spread[0],
        "covariance": spread[1],
        "T_map_object": T_map_object,
        "size": size,
        "labels": label_ids,
        "weights": label_weights,
        "anchor": _commonest(anchors[np.maximum(where, 0)], where >= 0),
    }.items():
        table[name][known] = values


def derive_in_batches(table: np.ndarray, *gaussians: np.ndarray, least: int) -> None:
    """Derive K landmarks as `derive` does, in batches that fit into the CPU cache.

    Args:
        table: Landmarks, [K] records of `LANDMARK`; changed in place.
        *gaussians: Arguments `rows`, `labels`, `ids` and `anchors` of `derive`.
        least: Argument `least` of `derive`.
    """
    for start in range(0, len(table), _AT_A_TIME):
        derive(table[start : start + _AT_A_TIME], *gaussians, least=least)


def _opacities(rows: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the opacities of members, [K, M]; 0 where a member is not in memory."""
    opacity = 1 / (1 + np.exp(-rows[np.maximum(where, 0), 10].astype(float)))
    return np.where(where >= 0, opacity, 0)


def moments(p_map: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted means and covariances of K sets of points.

        mu = sum_m w_m x_m / sum_m w_m,  Sigma = sum_m w_m (x_m - mu) (x_m - mu)' / sum_m w_m

    x_m is a point of a set, w_m is its weight, and ' means transpose. Along each axis, 2 % of the
    points at each end are excluded as outliers. See the LDO-SLAM paper, III.C.

    Args:
        p_map: Points in the map frame, [K, M, 3], meters.
        weights: Weights of the points, [K, M]; 0 for unused points.

    Returns:
        Means, [K, 3], meters, and covariances, [K, 3, 3], m^2.

    Example: two points lie on the x axis, at 0 m with weight 1 and at 4 m with weight 3. Along x,
    mu = 12 / 4 = 3 m and Sigma = (9 + 3) / 4 = 3 m^2.

    >>> mean, covariance = moments(np.array([[[0.0, 0, 0], [4, 0, 0]]]), np.array([[1.0, 3.0]]))
    >>> mean[0].tolist(), covariance[0].diagonal().tolist()
    ([3.0, 0.0, 0.0], [3.0, 0.0, 0.0])
    """
    low, high = trimmed(p_map, weights > 0)
    is_inside = np.all((p_map >= low[:, None]) & (p_map <= high[:, None]), axis=2)
    kept = np.where(np.any(is_inside & (weights > 0), axis=1, keepdims=True), is_inside, True)
    w = weights * kept
    w = (w / w.sum(axis=1, keepdims=True))[..., None]
    mean = np.sum(w * p_map, axis=1)
    offset = p_map - mean[:, None]
    return mean, np.swapaxes(w * offset, 1, 2) @ offset


def trimmed(values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and maximum of values after removal of the lowest and highest 2 %.

    Args:
        values: K sets of M values in D dimensions, [K, M, D].
        valid: Values to use, [K, M] bool.

    Returns:
        Minimum and maximum of each set in each dimension, [K, D] each. If a set has no valid value,
        its minimum is infinity and its maximum is minus infinity.
    """
    count = np.count_nonzero(valid, axis=1)[:, None]
    ordered = np.where(valid[:, None], np.swapaxes(values, 1, 2), np.inf)
    ordered.sort(axis=2)
    cut = (TRIM * count).astype(int)
    k, d = np.ogrid[: len(values), : values.shape[2]]
    low, high = ordered[k, d, cut], ordered[k, d, np.maximum(count - 1 - cut, 0)]
    return low, np.where(count > 0, high, -np.inf)


SAVING = 0.8  # The oriented box is used if its volume is below this fraction of the other's.


def boxes(
    p_map: np.ndarray, valid: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes around K sets of points.

    By default, a box is parallel to the axes of the map. It is parallel to the principal axes of
    the points if that reduces its volume to less than 80 %. Along each axis of a box, 2 % of the
    points at each end are excluded as outliers.

    Args:
        p_map: Points in the map frame, [K, M, 3], meters.
        valid: Points to use, [K, M] bool.
        covariance: Covariances of the points, [K, 3, 3], m^2.

    Returns:
        T_map_object, [K, 4, 4], with the center and axes of each box, and the sizes of the boxes
        along these axes, [K, 3], meters.
    """
    _, main = np.linalg.eigh(covariance)
    main = main[..., ::-1] * np.sign(_largest(main[..., ::-1]))[:, None]  # Fix the arbitrary signs.
    main[..., 2] *= np.linalg.det(main)[:, None]
    upright = np.broadcast_to(np.eye(3), main.shape)
    (low, high), (turned_low, turned_high) = (
        trimmed(p_map @ axes, valid) for axes in (upright, main)
    )
    is_turned = np.prod(turned_high - turned_low, axis=1) < SAVING * np.prod(high - low, axis=1)
    low, high = (
        np.where(is_turned[:, None], turned, plain)
        for turned, plain in ((turned_low, low), (turned_high, high))
    )
    T = np.tile(np.eye(4), (len(p_map), 1, 1))
    T[:, :3, :3] = np.where(is_turned[:, None, None], main, upright)
    T[:, :3, 3] = (T[:, :3, :3] @ ((low + high) / 2)[..., None])[..., 0]
    return T, high - low


def _largest(axes: np.ndarray) -> np.ndarray:
    """Return the largest component by magnitude of each column, [K, 3], of matrices [K, 3, 3]."""
    at = np.argmax(np.abs(axes), axis=1)[:, None]
    return np.take_along_axis(axes, at, axis=1)[:, 0]


def _commonest(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the most frequent valid value of each of K rows.

    If several values are equally frequent, the smallest is returned. `values` and `valid` have the
    shape [K, M], the result has the shape [K].
    """
    ordered = np.sort(np.where(valid, values, np.iinfo(np.int32).max).astype(np.int64), axis=1)
    width = ordered.shape[1]
    starts = np.concatenate(
        [np.ones((len(ordered), 1), bool), ordered[:, 1:] != ordered[:, :-1]], axis=1
    )
    first = np.maximum.accumulate(np.where(starts, np.arange(width), 0), axis=1)
    run = np.where(ordered < np.iinfo(np.int32).max, np.arange(width) - first, -1)
    return np.take_along_axis(ordered, np.argmax(run, axis=1)[:, None], axis=1)[:, 0]


def moved(table: np.ndarray, T_new_old: np.ndarray) -> None:
    """Move each of K landmarks by its correction T_new_old [K, 4, 4] in the map frame, in place."""
    R, t = T_new_old[:, :3, :3], T_new_old[:, :3, 3]
    table["centroid"] = (R @ table["centroid"][..., None])[..., 0] + t
    table["covariance"] = R @ table["covariance"] @ np.swapaxes(R, 1, 2)
    table["T_map_object"] = T_new_old @ table["T_map_object"]


# --- visibility -----------------------------------------------------------------------------------
def within(table: np.ndarray, camera: Camera, T_camera_map: np.ndarray) -> np.ndarray:
    """Return which landmarks may be in view of a camera, [K] bool.

    A landmark may be in view if its bounding sphere intersects the camera's view. `table` has K
    records of `LANDMARK`.
    """
    p = table["centroid"] @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    # Twice the radius of the box's bounding sphere, because some members lie outside of the box.
    radius = np.linalg.norm(table["size"], axis=1)
    low = (-0.5 - camera.cx) / camera.fx, (-0.5 - camera.cy) / camera.fy
    out = p[:, 2] > -radius
    for axis, (first, side) in enumerate(
        zip(low, (camera.width / camera.fx, camera.height / camera.fy), strict=True)
    ):
        for edge, sign in ((first, 1), (first + side, -1)):
            out &= sign * (p[:, axis] - edge * p[:, 2]) > -radius * np.hypot(1, edge)
    return out
