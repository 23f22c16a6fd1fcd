"""One box for one object: overlapping boxes of the same class yield to the most certain."""

import numpy as np


def non_maximum_suppression(
    boxes: np.ndarray, scores: np.ndarray, class_ids: np.ndarray, iou_max: float
) -> np.ndarray:
    """Which boxes to keep, the most certain first.

    Greedy: a box goes when it overlaps a kept one of its class by IoU > iou_max. Equal scores are
    taken in their order.

    boxes      [M, 4] x0, y0, x1, y1
    scores     [M]
    class_ids  [M]

    Returns indices [K] int64.
    """
    order = np.argsort(-scores, kind="stable")
    boxes, class_ids = boxes[order].astype(np.float64), class_ids[order]
    is_left = np.ones(len(order), bool)
    kept: list[int] = []
    for i in range(len(order)):
        if not is_left[i]:
            continue
        kept.append(i)
        rest = slice(i + 1, None)
        repeats = (class_ids[rest] == class_ids[i]) & (iou(boxes[i], boxes[rest]) > iou_max)
        is_left[rest] &= ~repeats
    return order[kept]


def iou(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Intersection over union of a box [4] with others [M, 4]; 0 where both are empty."""
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    intersection = np.maximum(sides, 0).prod(axis=1)
    union = _area(box) + _area(others) - intersection
    return np.divide(intersection, union, out=np.zeros_like(union), where=union > 0)


def _area(boxes: np.ndarray) -> np.ndarray:
    return (boxes[..., 2:] - boxes[..., :2]).prod(axis=-1)
