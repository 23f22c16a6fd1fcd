"""One box for one object, judged by a plain twin and by OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.detection.yolo import non_maximum_suppression


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    area_a, area_b = ((c[2] - c[0]) * (c[3] - c[1]) for c in (a, b))
    return width * height / (area_a + area_b - width * height)


def plain_suppression(boxes, scores, class_ids, iou_max: float) -> list[int]:
    """Kept are those that no kept one before them repeats."""
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: -scores[i]):
        repeats = (
            class_ids[i] == class_ids[j] and plain_iou(boxes[i], boxes[j]) > iou_max for j in kept
        )
        if not any(repeats):
            kept.append(i)
    return kept


def random_boxes(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Many of them overlap, and some scores are equal."""
    rng = np.random.default_rng(seed)
    centers, sides = rng.uniform(0, 100, (count, 2)), rng.uniform(5, 60, (count, 2))
    boxes = np.hstack((centers - sides / 2, centers + sides / 2))
    return boxes, rng.integers(0, 40, count) / 40, rng.integers(0, 3, count)


@given(st.integers(0, 2**32 - 1), st.integers(0, 40), st.floats(0, 1))
def test_it_keeps_what_the_plain_twin_keeps(seed: int, count: int, iou_max: float) -> None:
    boxes, scores, class_ids = random_boxes(seed, count)
    kept = non_maximum_suppression(boxes, scores, class_ids, iou_max)
    assert kept.tolist() == plain_suppression(boxes, scores, class_ids, iou_max)


@pytest.mark.parametrize("seed", range(5))
def test_opencv_keeps_the_same(seed: int) -> None:
    boxes, _, class_ids = random_boxes(seed, 400)
    scores = np.random.default_rng(seed).permutation(400) / 400 + 0.01
    sides = np.hstack((boxes[:, :2], boxes[:, 2:] - boxes[:, :2]))
    theirs = cv2.dnn.NMSBoxesBatched(sides, scores, class_ids, 0.0, 0.45)  # type: ignore[call-overload]
    ours = non_maximum_suppression(boxes, scores, class_ids, 0.45)
    assert sorted(ours) == sorted(np.ravel(theirs))
    assert 5 < len(ours) < 300


def test_the_same_box_stays_once_for_each_class() -> None:
    boxes = np.tile([[10.0, 10, 20, 20]], (4, 1))
    kept = non_maximum_suppression(
        boxes, np.array([0.5, 0.9, 0.7, 0.6]), np.array([0, 1, 0, 1]), 0.5
    )
    assert kept.tolist() == [1, 2]


def test_touching_boxes_and_no_boxes_are_left_alone() -> None:
    boxes = np.array([[0.0, 0, 10, 10], [10.0, 0, 20, 10]])
    assert len(non_maximum_suppression(boxes, np.ones(2), np.zeros(2, int), 0.0)) == 2
    nothing = non_maximum_suppression(np.zeros((0, 4)), np.zeros(0), np.zeros(0, int), 0.5)
    assert nothing.shape == (0,)
