"""Axis-aligned boxes in an image: x0, y0, x1, y1 in pixels."""

import cv2
import numpy as np


def non_maximum_suppression(
    boxes: np.ndarray, scores: np.ndarray, class_ids: np.ndarray, max_iou: float
) -> np.ndarray:
    """Return which boxes to keep, highest score first.

    The search is greedy: a box is dropped if its intersection over union with a kept box of its
    class exceeds `max_iou`. Equal scores are taken in the order of the arguments.

    Args:
        boxes: Boxes, [M, 4]; coordinates above -1 where there are several classes.
        scores: Scores, [M]; at least 0.
        class_ids: Classes, [M]; at least 0. Boxes of different classes never suppress each other.
        max_iou: Largest overlap that two kept boxes may have, 0..1; compared in single precision.

    Returns:
        Indices of the kept boxes, [K] int64.
    """
    rectangles = np.hstack((boxes[:, :2], boxes[:, 2:] - boxes[:, :2]))
    above = -1.0  # OpenCV keeps scores above a threshold; a score of 0 counts here.
    kept = cv2.dnn.NMSBoxesBatched(rectangles, scores, class_ids, above, max_iou)  # type: ignore[call-overload]
    return np.array(kept, np.int64)
