"""Instance segmentation by the objects of a map, and its average precision (AP)."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera, se3
from ldo_service.geometry.sequence import FrameLabels

from .label_lists import VOID, LabelSet
from .label_measures import MIN_SHARE

# AP is the mean over these thresholds of the IoU; AP50 and AP25 are at 0.5 and at 0.25.
AP_IOUS = tuple(round(0.5 + 0.05 * k, 2) for k in range(9))
NO_OBJECT = -1
# A box leaves out 2 % of the object's Gaussians at each end of each axis. With this margin around
# the boxes, 11 % instead of 18 % of the labelled pixels of an apartment belong to no object.
MARGIN_M = 0.05
_IDS = 1 << 16  # Number of values of an instance id.


@dataclass(frozen=True, eq=False, slots=True)
class SavedObjects:
    """Objects of a map, as objects.json lists them.

    Attributes:
        names: Names of the K objects.
        confidences: Probability of the name of each object, [K], 0..1.
        T_map_object: Center and axes of the box of each object, [K, 4, 4].
        sizes: Extents of each box along its axes, [K, 3], meters.
    """

    names: tuple[str, ...]
    confidences: np.ndarray
    T_map_object: np.ndarray
    sizes: np.ndarray

    def image(
        self,
        labels: np.ndarray,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_camera: np.ndarray,
        label_names: Sequence[str],
    ) -> np.ndarray:
        """Return the object of each pixel of a rendered image, [H, W] int32; -1 for no object.

        A pixel belongs to an object if its label is the name of the object, and its surface point
        is in the box of the object or at most 5 cm from a side. If this holds for several objects,
        the pixel belongs to the one with the nearest center, relative to the size of its box.

        Args:
            labels: Labels of the map, [H, W] uint8.
            depth_m: Rendered depth, [H, W], meters; 0 without a surface.
            camera: Intrinsics of the image.
            T_map_camera: Pose of the camera, [4, 4].
            label_names: Names of the labels, by label.
        """
        image = np.full(labels.size, NO_OBJECT, np.int32)
        nearest = np.full(labels.size, np.inf)
        p_camera = camera.backproject(depth_m).reshape(-1, 3)
        label_of = {name: label for label, name in enumerate(label_names)}
        for k, name in enumerate(self.names):
            has_name = (labels == label_of.get(name, -1)) & (depth_m > 0)
            pixels = np.flatnonzero(has_name)
            T_object_camera = se3.inverse(self.T_map_object[k]) @ T_map_camera
            p_object = np.abs(se3.transform(T_object_camera, p_camera[pixels]))
            relative = p_object / (self.sizes[k] / 2 + MARGIN_M)
            distances = np.where(np.all(relative <= 1, axis=1), np.sum(relative**2, axis=1), np.inf)
            is_nearer = distances < nearest[pixels]
            image[pixels[is_nearer]], nearest[pixels] = k, np.minimum(distances, nearest[pixels])
        return image.reshape(labels.shape)


@dataclass(frozen=True, slots=True)
class InstancePrecision:
    """Average precision of the objects of a map, as means over classes or for one class, 0..1.

    The values are NaN without a true instance.
    """

    ap: float  # Mean over the thresholds 0.5, 0.55, ..., 0.9 of the IoU.
    ap50: float  # The threshold of the IoU is 0.5.
    ap25: float  # The threshold of the IoU is 0.25.


@dataclass(frozen=True, eq=False, slots=True)
class InstanceOverlaps:
    """Pixels of the true and the found instances, for one list of classes.

    Attributes:
        true_classes: Class of each of G true instances, [G].
        true_pixels: Number of pixels of each true instance, [G].
        found_classes: Class of each of P found instances, [P].
        found_pixels: Number of pixels of each found instance, [P].
        confidences: Confidence of each found instance, [P].
        shared: Number of pixels that a true and a found instance share, [G, P].
        ignored: Number of pixels of each found instance whose truth is ignored, [P].
    """

    true_classes: np.ndarray
    true_pixels: np.ndarray
    found_classes: np.ndarray
    found_pixels: np.ndarray
    confidences: np.ndarray
    shared: np.ndarray
    ignored: np.ndarray

    def of_class(self, class_: int) -> "InstanceOverlaps":
        """Return the instances of one class."""
        g, p = self.true_classes == class_, self.found_classes == class_
        return InstanceOverlaps(
            *(self.true_classes[g], self.true_pixels[g], self.found_classes[p]),
            *(self.found_pixels[p], self.confidences[p], self.shared[np.ix_(g, p)]),
            self.ignored[p],
        )


def class_precision(overlaps: InstanceOverlaps, min_pixels: int) -> dict[int, InstancePrecision]:
    """Return the average precision of each class that has a true instance.

    The definition is that of the ScanNet benchmark (Dai et al., CVPR 2017), in its script
    evaluate_semantic_instance.py. A found instance is a true positive if its IoU with a true
    instance of its class exceeds the threshold. If several found instances have such an IoU with
    one true instance, those with less confidence are false positives. A found instance without a
    match is a false positive, unless more than the threshold of its pixels is ignored. Pixels of
    true instances below `min_pixels` are ignored too. AP is the area under the curve of precision
    over recall, with linear interpolation between the confidences that occur.

    Args:
        overlaps: True and found instances of all classes.
        min_pixels: True and found instances with fewer pixels are left out.
    """
    found = {}
    for class_ in np.unique(overlaps.true_classes[overlaps.true_pixels >= min_pixels]).tolist():
        of_class = overlaps.of_class(class_)
        aps = [average_precision(of_class, iou, min_pixels) for iou in (*AP_IOUS, 0.25)]
        found[class_] = InstancePrecision(float(np.mean(aps[:-1])), aps[0], aps[-1])
    return found


def average_precision(overlaps: InstanceOverlaps, min_iou: float, min_pixels: int) -> float:
    """Return the average precision of the instances of one class at a threshold of the IoU.

    Args:
        overlaps: True and found instances of the class.
        min_iou: The IoU of a match must exceed this value.
        min_pixels: True and found instances with fewer pixels are left out.
    """
    union = overlaps.true_pixels[:, None] + overlaps.found_pixels - overlaps.shared
    is_large = overlaps.found_pixels >= min_pixels
    matches = (overlaps.shared / union > min_iou) & is_large
    counted = overlaps.true_pixels >= min_pixels
    is_used = np.zeros(len(is_large), bool)
    scores: list[tuple[float, bool]] = []  # Confidence of a prediction, and whether it is right.
    for matched in matches[counted]:
        candidates = np.flatnonzero(matched & ~is_used)
        if len(candidates):
            is_used[candidates[0]] = True
            ranked = sorted(overlaps.confidences[candidates].tolist(), reverse=True)
            scores += [(ranked[0], True), *((score, False) for score in ranked[1:])]
    ignored = overlaps.ignored + overlaps.shared[~counted].sum(axis=0)
    is_wrong = is_large & ~matches.any(axis=0) & (ignored <= min_iou * overlaps.found_pixels)
    scores += [(score, False) for score in overlaps.confidences[is_wrong].tolist()]
    return area_under_curve(scores, int(np.count_nonzero(counted)))


def area_under_curve(scores: Sequence[tuple[float, bool]], wanted: int) -> float:
    """Return the area under the curve of precision over recall, 0..1.

    The curve has a point for each confidence that occurs: precision and recall of the predictions
    with at least this confidence. It starts at recall 0 and precision 1, and is linear between two
    points.

    Args:
        scores: Confidence of each prediction, and whether the prediction is right.
        wanted: Number of true instances, at least 1.

    Example: of two true instances, the first is found, and a wrong prediction has less confidence.

    >>> area_under_curve([(0.9, True), (0.4, False)], 2)
    0.5
    """
    area, recall, precision = 0.0, 0.0, 1.0
    for least in sorted({score for score, _ in scores}, reverse=True):
        kept = [is_right for score, is_right in scores if score >= least]
        next_recall, next_precision = sum(kept) / wanted, sum(kept) / len(kept)
        area += (next_recall - recall) * (precision + next_precision) / 2
        recall, precision = next_recall, next_precision
    return area


class InstanceEvaluator:
    """Accumulator of the pixels that true instances and the objects of a map share."""

    def __init__(self, objects: SavedObjects) -> None:
        self._objects = objects
        # Number of pixels by class id, instance id and object, joined to one number.
        self._pixels: Counter[int] = Counter()
        self._image_pixels = 0

    def see(self, truth: FrameLabels, shown: np.ndarray) -> None:
        """Add a view.

        Args:
            truth: Ground-truth labels of the view.
            shown: Object of each pixel, [H, W], as `SavedObjects.image` returns it.
        """
        columns = len(self._objects.names) + 1
        instances = truth.class_ids.astype(np.int64) * _IDS + truth.instance_ids
        keys, counts = np.unique(instances * columns + shown + 1, return_counts=True)
        self._pixels.update(dict(zip(keys.tolist(), counts.tolist(), strict=True)))
        self._image_pixels = shown.size

    @property
    def min_pixels(self) -> int:
        """Minimum size of an instance: 0.5 % of the pixels of one image, over all views."""
        return int(np.ceil(MIN_SHARE * self._image_pixels))

    def precision(
        self, labels: LabelSet, class_names: Sequence[str]
    ) -> dict[str, InstancePrecision]:
        """Return the average precision by class name, for the classes with a true instance.

        Args:
            labels: List of classes.
            class_names: Names of the classes of the data set, by class id.
        """
        overlaps = self.overlaps(labels, class_names)
        found = class_precision(overlaps, self.min_pixels)
        return {labels.names[class_]: precision for class_, precision in found.items()}

    def overlaps(self, labels: LabelSet, class_names: Sequence[str]) -> InstanceOverlaps:
        """Return the pixels of all instances by their classes in a list.

        The classes of the list except background have instances. Truth without a class in the list
        is ignored, and so is truth of a class with instances that names no instance.
        """
        of_truth = labels.of_truth(class_names)
        classes = labels.of_map(self._objects.names)[: len(self._objects.names)]
        keys = np.array(sorted(self._pixels), np.int64)
        counts = np.array([self._pixels[key] for key in keys.tolist()], np.int64)
        instances, columns = np.divmod(keys, len(self._objects.names) + 1)
        true_classes, ids = of_truth[instances // _IDS], instances % _IDS
        has_class = (true_classes != 0) & (true_classes != VOID)
        is_instance = has_class & (ids > 0)
        is_ignored = (true_classes == VOID) | (has_class & (ids == 0))
        true, rows = np.unique(
            np.stack([true_classes, ids], axis=1)[is_instance], axis=0, return_inverse=True
        )
        shared = np.zeros((len(true), len(classes) + 1), np.int64)
        np.add.at(shared, (rows.ravel(), columns[is_instance]), counts[is_instance])

        def by_object(chosen: np.ndarray) -> np.ndarray:
            return np.bincount(columns[chosen], counts[chosen], len(classes) + 1)[1:].astype(int)

        return InstanceOverlaps(
            *(true[:, 0], shared.sum(axis=1), classes, by_object(np.full(len(keys), True))),
            *(self._objects.confidences, shared[:, 1:], by_object(is_ignored)),
        )


def mean_precision(by_class: dict[str, InstancePrecision]) -> InstancePrecision:
    """Return the means over classes; NaN without classes."""
    if not by_class:
        return InstancePrecision(*[float("nan")] * 3)
    values = [(one.ap, one.ap50, one.ap25) for one in by_class.values()]
    return InstancePrecision(*np.mean(values, axis=0).tolist())
