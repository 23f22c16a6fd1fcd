"""What a keyframe that shows landmarks adds to what is remembered of them."""

import numpy as np

from .assignment import HIDDEN
from .association import MapView
from .landmarks import MOST_VOTES, NO_MEMBER, VIEWS


def one_each(members: np.ndarray) -> np.ndarray:
    return (members != NO_MEMBER).astype(np.int8)


def voted(votes: np.ndarray, rows: np.ndarray, view: MapView, numbers: np.ndarray) -> np.ndarray:
    """Votes [K, 256] one higher for members, in `rows` of the map, that lie in the region `numbers`
    [K] of their landmark, and one lower for those that were seen beside it or are no more."""
    wanted = np.maximum(rows, 0).astype(view.indices.dtype)  # or all of `indices` is converted
    at = np.minimum(np.searchsorted(view.indices, wanted), len(view.indices) - 1)
    is_shown = view.indices[at] == rows
    region = np.where(is_shown, view.regions[at], HIDDEN)
    is_in = region == numbers[:, None]
    is_out = (rows < 0) | ((region != HIDDEN) & ~is_in)
    change = is_in.astype(np.int8) - is_out.astype(np.int8)
    return np.where(votes > 0, np.clip(votes + change, 0, MOST_VOTES), 0).astype(np.int8)


def remember(table: np.ndarray, keyframe: int, shown: np.ndarray, boxes: np.ndarray) -> None:
    """Large boxes with much of the object in them are good views."""
    scores = shown * np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))
    add_view(table, np.full(len(table), keyframe), scores, boxes)


def add_view(
    table: np.ndarray, keyframes: np.ndarray, scores: np.ndarray, boxes: np.ndarray
) -> None:
    """The best of the views that landmarks [K] have and one more of each, in place."""
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
