"""Scores of labels: confusion matrix, agreement between views, and names without a COCO class."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.sequence import FrameLabels

from .label_lists import BACKGROUND, VOID, LabelSet, object_name

NEAREST_M = 0.05  # Minimum depth in the second camera of a point that is compared.
SAME_SURFACE = 0.02  # Maximum relative difference of two depths that show one surface.

MIN_SHARE = 0.005  # Minimum size of an object that counts, as a fraction of the pixels of a view.


@dataclass(frozen=True, eq=False, slots=True)
class Correspondences:
    """Pixels of two images that show the same surface points.

    Attributes:
        first: Flat pixel indices of the first view, [M].
        second: Flat pixel indices of the second view, [M].
    """

    first: np.ndarray
    second: np.ndarray


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of labels at corresponding pixels of pairs of images."""

    same: int = 0  # Number of pixels with the same object label in both views.
    objects: int = 0  # Number of pixels with an object label in at least one view.

    def __add__(self, other: "Agreement") -> "Agreement":
        return Agreement(self.same + other.same, self.objects + other.objects)

    @property
    def share(self) -> float:
        """Fraction of the pixel pairs that have equal labels; NaN if there are no pairs.

        Pairs that show background in both views are excluded, because most of them agree.
        """
        return self.same / self.objects if self.objects else float("nan")


def correspondences(
    first: RgbdFrame, second: RgbdFrame, T_second_first: np.ndarray
) -> Correspondences:
    """Return the corresponding pixels of two views.

    A pixel of the first view is projected into the second view with its measured depth, and rounded
    to the nearest pixel. The two pixels correspond if the measured depth of the second pixel
    differs by less than 2 % from the projected depth, so that both show one surface.

    Args:
        first: The first view.
        second: The second view.
        T_second_first: Transform from the first to the second camera, [4, 4].
    """
    camera, measured = second.camera, np.flatnonzero(first.depth_m)
    points = first.camera.backproject(first.depth_m).reshape(-1, 3)[measured]
    p_second = se3.transform(T_second_first, points)
    ahead = p_second[:, 2] > NEAREST_M
    measured, p_second = measured[ahead], p_second[ahead]
    u, v = np.rint(camera.project(p_second)).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    there = v[inside] * camera.width + u[inside]
    gaps = np.abs(second.depth_m.ravel()[there] / p_second[inside, 2] - 1)
    is_same = gaps < SAME_SURFACE
    return Correspondences(measured[inside][is_same], there[is_same])


def agreement(first: np.ndarray, second: np.ndarray, pixels: Correspondences) -> Agreement:
    """Count pairs of corresponding pixels, and the pairs among them with equal labels.

    A pair counts only if at least one of its two pixels shows an object.

    Args:
        first: Labels of the first view, [H, W]; 0 is background.
        second: Labels of the second view, [H, W]; 0 is background.
        pixels: Corresponding pixels of the views.
    """
    here, there = first.ravel()[pixels.first], second.ravel()[pixels.second]
    objects = (here > 0) | (there > 0)
    return Agreement(int(np.sum((here == there) & objects)), int(np.sum(objects)))


@dataclass(frozen=True, slots=True)
class DetectionCounts:
    """Recall and precision of the names in a map, and the counts behind these scores.

    The counts are either numbers of objects or numbers of pixels: `wanted` have a name in the
    ground truth, `named` have a name in the map, and `right` have the same name in both.
    """

    right: int = 0  # Named correctly in the map.
    wanted: int = 0  # Named in the ground truth; recall is right / wanted.
    named: int = 0  # Named in the map; precision is right / named.

    def __add__(self, other: "DetectionCounts") -> "DetectionCounts":
        return DetectionCounts(
            self.right + other.right, self.wanted + other.wanted, self.named + other.named
        )

    @property
    def recall(self) -> float:
        """Fraction of the true names that the map has right; NaN if there are no true names."""
        return self.right / self.wanted if self.wanted else float("nan")

    @property
    def precision(self) -> float:
        """Fraction of the map's names that are right; NaN if the map has no names."""
        return self.right / self.named if self.named else float("nan")


class OpenNames:
    """Recall and precision of names without a COCO class, for pixels and for objects of all views.

    An object is an instance in the ground truth of the data set. The map's name for an object is
    the name of most of the object's pixels. A view in which the object fills less than 0.5 % of the
    image does not contribute to this name. Parts of the building count as objects here, because the
    map may give a wall the name of an object.
    """

    def __init__(self, labels: LabelSet, map_names: Sequence[str]) -> None:
        """Start with no views.

        Args:
            labels: The full list of a data set, see `label_lists.full_list`.
            map_names: Names of the map's labels, by label.
        """
        self.pixels = DetectionCounts()
        self._of_map = labels.of_map(map_names)
        self._is_named = _table(map_names)
        self._is_wanted = _table(labels.names)
        # Number of pixels with each label of the map, [256], by instance id.
        self._votes: dict[int, np.ndarray] = {}
        self._truth: dict[int, int] = {}  # True index in the list, by instance id.

    def add(self, frame: FrameLabels, truth: np.ndarray, shown: np.ndarray) -> None:
        """Add the pixels and the objects of a view to the scores.

        Args:
            frame: Ground-truth labels of the view.
            truth: Index of each pixel's true name in the `labels` of the constructor, [H, W] uint8;
                VOID where the ground truth is ignored.
            shown: Labels of the map, rendered in this view, [H, W] uint8.
        """
        self._add_pixels(truth, shown)
        sizes = np.bincount(frame.instance_ids.ravel())
        for instance in np.flatnonzero(sizes >= MIN_SHARE * truth.size).tolist():
            mask = (frame.instance_ids == instance) & (truth != VOID)
            if mask.any():
                votes = np.bincount(shown[mask], minlength=256)
                self._votes[instance] = self._votes.get(instance, 0) + votes
                self._truth[instance] = int(np.bincount(truth[mask]).argmax())

    def _add_pixels(self, truth: np.ndarray, shown: np.ndarray) -> None:
        counted = truth != VOID
        truth, shown = truth[counted], shown[counted]
        named, wanted = self._is_named[shown], self._is_wanted[truth]
        right = named & (self._of_map[shown] == truth)
        self.pixels += DetectionCounts(
            *(int(np.count_nonzero(kind)) for kind in (right, wanted, named))
        )

    @property
    def objects(self) -> DetectionCounts:
        """Counts of the objects over all added views."""
        called = {instance: int(votes.argmax()) for instance, votes in self._votes.items()}
        named = [instance for instance, label in called.items() if self._is_named[label]]
        right = [i for i in named if self._of_map[called[i]] == self._truth[i]]
        wanted = [truth for truth in self._truth.values() if self._is_wanted[truth]]
        return DetectionCounts(len(right), len(wanted), len(named))


def is_beyond_coco(name: str) -> bool:
    """Return whether a name denotes an object without a COCO class; the name "other" does not."""
    return object_name(name) not in (BACKGROUND, "other", *COCO)


def _table(names: Sequence[str]) -> np.ndarray:
    """Return a table [256] bool, True at the index of each name of an object without a COCO class.

    See `is_beyond_coco`.
    """
    table = np.zeros(256, bool)
    table[: len(names)] = [is_beyond_coco(name) for name in names]
    return table


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Metrics that `segmentation` computes, 0..1; NaN if no pixel is evaluated."""

    classes: int  # Number of evaluated classes.
    pixel_accuracy: float  # Fraction of the pixels with ground truth that have the right label.
    mean_accuracy: float  # Mean accuracy over the evaluated classes.
    mean_iou: float  # Mean IoU over the evaluated classes.
    object_iou: float  # Mean IoU over the evaluated classes except background.
    weighted_iou: float  # Mean IoU, weighted by the number of true pixels of each class.


def confusion(truth: np.ndarray, shown: np.ndarray, classes: int) -> np.ndarray:
    """Return the confusion matrix: the number of pixels by true class and by class in the map.

    The matrices of several images may be added. The metrics of the sum are the metrics of all
    pixels together.

    >>> confusion(np.uint8([0, 0, 1, 255]), np.uint8([0, 1, 254, 1]), 2).tolist()
    [[1, 1, 0], [0, 0, 1]]

    Args:
        truth: Index of the true name in a list of C names, [H, W] uint8; VOID is ignored.
        shown: Index of the map's name in the same list, [H, W] uint8; any value >= C stands for an
            unknown name.
        classes: Number of names, C.

    Returns:
        Number of pixels by true class and by class in the map, [C, C + 1] int64. The last column
        counts pixels with an unknown name in the map.
    """
    counted = truth != VOID
    columns = np.minimum(shown[counted], classes)
    cells = truth[counted].astype(np.int64) * (classes + 1) + columns
    return np.bincount(cells, minlength=classes * (classes + 1)).reshape(classes, classes + 1)


def segmentation(counts: np.ndarray, gate: float = 0.0) -> Segmentation:
    """Return the metrics of a confusion matrix.

    For each class, `true` is the number of its pixels in the ground truth, `shown` is the number of
    its pixels in the map, and `right` is the number of its pixels in both:

        accuracy = right / true,  IoU = right / (true + shown - right)

    A mean over classes includes each class that has more than the fraction `gate` of all true
    pixels. Pixels with an unknown name in the map count as wrong. Long et al., CVPR 2015,
    section 5, define pixel accuracy, mean accuracy, mean IoU and frequency-weighted IoU.

    Args:
        counts: Number of pixels by true class and by class in the map, [C, C + 1], as `confusion`
            returns it. Class 0 is background; the last column is for unknown names in the map.
        gate: A class enters the means if its fraction of all true pixels exceeds this value, 0..1.

    Example: The map labels one of the two pixels of a cup, and one pixel of the wall, as cup.

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
    """Return the IoU of each class, [C]; NaN if neither ground truth nor map has the class.

    Args:
        counts: Number of pixels by true class (row) and by class in the map (column), [C, C + 1],
            as `confusion` returns it. The last column is for unknown names in the map.
    """
    right = np.diag(counts)
    union = counts.sum(axis=1) + counts.sum(axis=0)[:-1] - right
    return np.where(union > 0, right / np.maximum(union, 1), np.nan)
