"""Boxes in an image, compared with plain loops."""

import doctest

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ldo_service.geometry import boxes as boxes_module
from ldo_service.geometry.boxes import ious, non_maximum_suppression


def test_examples_in_docstrings_hold() -> None:
    assert doctest.testmod(boxes_module).failed == 0


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    area_a, area_b = ((c[2] - c[0]) * (c[3] - c[1]) for c in (a, b))
    return width * height / (area_a + area_b - width * height)


def plain_suppression(boxes, scores, class_ids, max_iou: float) -> list[int]:
    """Keep each box that does not repeat a kept box of higher score."""
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: -scores[i]):
        repeats = (
            class_ids[i] == class_ids[j] and plain_iou(boxes[i], boxes[j]) > max_iou for j in kept
        )
        if not any(repeats):
            kept.append(i)
    return kept


def random_boxes(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return boxes, scores and classes; many boxes overlap, some scores are equal or 0."""
    rng = np.random.default_rng(seed)
    centers, sides = rng.uniform(0, 100, (count, 2)), rng.uniform(5, 60, (count, 2))
    boxes = np.hstack((centers - sides / 2, centers + sides / 2)).clip(-0.5)
    return boxes, rng.integers(0, 40, count) / 40, rng.integers(0, 3, count)


whole_boxes = arrays(np.int64, (3, 4), elements=st.integers(0, 12)).map(
    lambda a: np.concatenate([np.minimum(a[:, :2], a[:, 2:]), np.maximum(a[:, :2], a[:, 2:])], 1)
)


@given(whole_boxes, whole_boxes)
def test_intersection_over_union_is_that_of_counted_pixels(
    one: np.ndarray, other: np.ndarray
) -> None:
    def mask(box: np.ndarray) -> np.ndarray:
        out = np.zeros((12, 12), bool)
        out[box[1] : box[3], box[0] : box[2]] = True
        return out

    got = ious(one, other)
    for i, j in np.ndindex(3, 3):
        a, b = mask(one[i]), mask(other[j])
        union = np.count_nonzero(a | b)
        assert abs(got[i, j] - (np.count_nonzero(a & b) / union if union else 0)) < 1e-12


@given(st.integers(0, 2**32 - 1), st.integers(0, 40), st.floats(0, 1))
def test_suppression_equals_plain_loops(seed: int, count: int, max_iou: float) -> None:
    boxes, scores, class_ids = random_boxes(seed, count)
    kept = non_maximum_suppression(boxes, scores, class_ids, max_iou)
    assert kept.tolist() == plain_suppression(boxes, scores, class_ids, max_iou)


def test_suppression_of_many_boxes_equals_plain_loops() -> None:
    boxes, scores, class_ids = random_boxes(0, 400)
    kept = non_maximum_suppression(boxes, scores, class_ids, 0.45)
    assert kept.tolist() == plain_suppression(boxes, scores, class_ids, 0.45)
    assert 5 < len(kept) < 300


def test_boxes_that_overlap_by_exactly_the_limit_are_kept() -> None:
    """Integers and a limit that a float holds exactly are not rounded."""
    boxes, scores, class_ids = np.array([[0, 0, 2, 1], [0, 0, 1, 1]]), np.ones(2), np.zeros(2, int)
    assert non_maximum_suppression(boxes, scores, class_ids, 0.5).tolist() == [0, 1]
    assert non_maximum_suppression(boxes, scores, class_ids, 0.499).tolist() == [0]


def test_equal_boxes_are_kept_once_per_class() -> None:
    boxes = np.tile([[10.0, 10, 20, 20]], (4, 1))
    kept = non_maximum_suppression(
        boxes, np.array([0.5, 0.9, 0.7, 0.6]), np.array([0, 1, 0, 1]), 0.5
    )
    assert kept.tolist() == [1, 2]


def test_touching_boxes_are_kept_and_no_boxes_give_none() -> None:
    boxes = np.array([[0.0, 0, 10, 10], [10.0, 0, 20, 10]])
    assert len(non_maximum_suppression(boxes, np.ones(2), np.zeros(2, int), 0.0)) == 2
    no_boxes = non_maximum_suppression(np.zeros((0, 4)), np.zeros(0), np.zeros(0, int), 0.5)
    assert no_boxes.shape == (0,)
