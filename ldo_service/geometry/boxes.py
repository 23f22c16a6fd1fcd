"""Axis-aligned boxes in an image: x0, y0, x1, y1 in pixels."""

import cv2
import numpy as np


def areas(boxes: np.ndarray) -> np.ndarray:
    """Return the areas [...] of boxes [..., 4], in square pixels."""
    return np.prod(boxes[..., 2:] - boxes[..., :2], axis=-1)


def intersections(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the intersection areas [K, R] of boxes [K, 4] and [R, 4], in square pixels."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.prod(np.maximum(high - low, 0), axis=-1)


def ious(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the intersection over union [K, R] of boxes [K, 4] and [R, 4]; 0 for empty boxes.

    >>> ious(np.array([[0, 0, 2, 2]]), np.array([[1, 0, 3, 2], [5, 5, 6, 6]])).round(3)
    array([[0.333, 0.   ]])
    """
    common = intersections(boxes, others)
    union = areas(boxes)[:, None] + areas(others) - common
    return np.divide(common, union, out=np.zeros(common.shape), where=common > 0)


def non_maximum_suppression(
    boxes: np.ndarray, scores: np.ndarray, class_ids: np.ndarray, max_iou: float
) -> np.ndarray:
    """Return the indices of the boxes to keep, highest score first.

    The search is greedy: a box is dropped if its intersection over union with a kept box of its
    class exceeds `max_iou`. Boxes of equal scores are processed in the order of `boxes`.

    Args:
        boxes: Boxes, [M, 4]. If there are several classes, coordinates must be above -1, because
            OpenCV separates the classes by shifting their boxes.
        scores: Scores, [M]; at least 0.
        class_ids: Classes, [M]; at least 0. Boxes of different classes never suppress each other.
        max_iou: Largest intersection over union of two kept boxes of the same class, 0..1;
            compared in single precision.

    Returns:
        Indices of the kept boxes, [K] int64.
    """
    rectangles = np.hstack((boxes[:, :2], boxes[:, 2:] - boxes[:, :2]))
    above = -1.0  # OpenCV keeps scores above this threshold; a score of 0 must pass.
    kept = cv2.dnn.NMSBoxesBatched(rectangles, scores, class_ids, above, max_iou)  # type: ignore[call-overload]
    return np.array(kept, np.int64)
