"""How well images of labels agree with the truth: counts of pixels, and what is made of them."""

from dataclasses import dataclass

import numpy as np

from .label_lists import VOID


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Figures 0..1; NaN where no pixel counts."""

    classes: int  # that are judged
    pixel_accuracy: float  # of all pixels that count
    mean_accuracy: float
    mean_iou: float
    object_iou: float  # the mean without background
    weighted_iou: float  # the mean weighted by frequency


def confusion(truth: np.ndarray, shown: np.ndarray, classes: int) -> np.ndarray:
    """Pixels of each class that are shown as each [C, C + 1] int64, in the last column as unknown.

    truth, shown  [H, W] uint8, index into a list of C names; truth VOID does not count, shown
                  beyond the list is unknown
    Those of several images, added up, give the figures of all their pixels.

    >>> confusion(np.uint8([0, 0, 1, 255]), np.uint8([0, 1, 254, 1]), 2).tolist()
    [[1, 1, 0], [0, 0, 1]]
    """
    counted = truth != VOID
    columns = np.minimum(shown[counted], classes)
    cells = truth[counted].astype(np.int64) * (classes + 1) + columns
    return np.bincount(cells, minlength=classes * (classes + 1)).reshape(classes, classes + 1)


def segmentation(counts: np.ndarray, gate: float = 0.0) -> Segmentation:
    """Figures of a confusion [C, C + 1] over the classes with more than `gate` of the pixels.

        accuracy = right / true,  IoU = right / (true + shown - right)

    of each class. What is shown of it includes pixels of classes that are not judged; what is
    unknown is wrong. Long et al., CVPR 2015, section 5, has the same four means.

    A cup of two pixels, one of them found, and one of the wall taken for it too:

    >>> found = segmentation(np.array([[7, 1, 0], [1, 1, 0]]))
    >>> found.pixel_accuracy, round(found.mean_iou, 3), round(found.object_iou, 3)
    (0.8, 0.556, 0.333)
    """
    true, right = counts.sum(axis=1), np.diag(counts)
    judged = np.flatnonzero(true > gate * true.sum())
    if len(judged) == 0:
        return Segmentation(0, *[float("nan")] * 5)
    accuracies, ious = right[judged] / true[judged], class_ious(counts)[judged]
    return Segmentation(
        len(judged),
        float(right.sum() / true.sum()),
        float(accuracies.mean()),
        float(ious.mean()),
        float(ious[judged > 0].mean()) if np.any(judged > 0) else float("nan"),
        float(np.average(ious, weights=true[judged])),
    )


def class_ious(counts: np.ndarray) -> np.ndarray:
    """[C] of a confusion [C, C + 1]; NaN for a class that is neither there nor shown."""
    right = np.diag(counts)
    union = counts.sum(axis=1) + counts.sum(axis=0)[:-1] - right
    return np.where(union > 0, right / np.maximum(union, 1), np.nan)
