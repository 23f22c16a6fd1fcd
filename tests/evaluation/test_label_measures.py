import numpy as np
import pytest

from ldo_service.evaluation.label_lists import UNKNOWN, VOID
from ldo_service.evaluation.label_measures import Segmentation, class_ious, confusion, segmentation

# Rows are the ground truth, and the last column is unknown. Of 94 pixels of background 90 are
# correct, and of 30 pixels of chairs 20. The only pixel of a cup is labelled a chair.
COUNTS = np.array([[90, 2, 0, 2], [8, 20, 1, 1], [0, 1, 0, 0]])


def segmentation_pixel_by_pixel(truth: np.ndarray, shown: np.ndarray, classes: int) -> Segmentation:
    """Return the measures by their definitions, one pixel and one class at a time."""
    pixels = [(t, s) for t, s in zip(truth.flat, shown.flat, strict=True) if t != VOID]
    accuracies, ious, sizes = [], [], []
    for label in range(classes):
        true = [s for t, s in pixels if t == label]
        if not true:
            continue
        right = sum(s == label for s in true)
        union = sum(label in pair for pair in pixels)
        accuracies.append(right / len(true))
        ious.append((label, right / union))
        sizes.append(len(true))
    return Segmentation(
        len(ious),
        sum(t == s for t, s in pixels) / len(pixels),
        sum(accuracies) / len(accuracies),
        sum(iou for _, iou in ious) / len(ious),
        float(np.mean([iou for label, iou in ious if label > 0])),
        sum(n * iou for n, (_, iou) in zip(sizes, ious, strict=True)) / sum(sizes),
    )


@pytest.mark.parametrize("seed", range(5))
def test_measures_equal_those_of_a_loop_over_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.choice(np.uint8([0, 0, 0, 1, 2, 4, VOID]), (24, 20))
    shown = np.where(rng.random(truth.shape) < 0.5, truth, rng.integers(0, 6, truth.shape))
    shown = np.where(rng.random(truth.shape) < 0.1, UNKNOWN, shown).astype(np.uint8)
    found = segmentation(confusion(truth, shown, 5))
    expected = segmentation_pixel_by_pixel(truth, shown, 5)
    for name in Segmentation.__dataclass_fields__:
        assert getattr(found, name) == pytest.approx(getattr(expected, name)), name


def test_measures_of_a_small_confusion_matrix() -> None:
    found = segmentation(COUNTS)
    ious = (90 / (94 + 98 - 90), 20 / (30 + 23 - 20), 0.0)
    assert class_ious(COUNTS) == pytest.approx(ious)
    assert found.classes == 3
    assert found.pixel_accuracy == pytest.approx(110 / 125)
    assert found.mean_accuracy == pytest.approx((90 / 94 + 20 / 30 + 0) / 3)
    assert found.mean_iou == pytest.approx(sum(ious) / 3)
    assert found.object_iou == pytest.approx(ious[1] / 2)
    assert found.weighted_iou == pytest.approx((94 * ious[0] + 30 * ious[1]) / 125)


def test_gate_excludes_rare_classes_but_keeps_their_pixels() -> None:
    found = segmentation(COUNTS, gate=0.01)
    assert found.classes == 2
    assert found.pixel_accuracy == segmentation(COUNTS).pixel_accuracy
    assert found.mean_iou == pytest.approx((90 / 102 + 20 / 33) / 2)
    assert segmentation(COUNTS, gate=1 / 125).classes == 2, "more than the gate, not as much"


def test_void_pixels_are_not_counted() -> None:
    truth = np.uint8([[0, 1, VOID, VOID]])
    counts = confusion(truth, np.uint8([[0, 1, 1, UNKNOWN]]), 2)
    assert counts.tolist() == [[1, 0, 0], [0, 1, 0]]
    assert segmentation(counts).mean_iou == 1


def test_unknown_name_is_wrong_on_objects_and_background() -> None:
    counts = confusion(np.uint8([0, 0, 1, 1]), np.uint8([0, UNKNOWN, 1, UNKNOWN]), 2)
    assert counts.tolist() == [[1, 0, 1], [0, 1, 1]]
    assert segmentation(counts).mean_iou == pytest.approx(0.5)


def test_images_are_pooled_by_adding_their_confusions() -> None:
    rng = np.random.default_rng(0)
    truth, shown = rng.integers(0, 3, (2, 4, 8, 8)).astype(np.uint8)
    both = sum(confusion(a, b, 3) for a, b in zip(truth, shown, strict=True))
    np.testing.assert_array_equal(both, confusion(truth, shown, 3))


def test_measures_without_pixels_are_nan() -> None:
    found = segmentation(confusion(np.full((2, 2), VOID), np.zeros((2, 2), np.uint8), 3))
    assert found.classes == 0
    assert np.isnan([found.pixel_accuracy, found.mean_iou, found.object_iou]).all()
    background = segmentation(np.array([[5, 0]]))
    assert (background.mean_iou, np.isnan(background.object_iou)) == (1, True)
