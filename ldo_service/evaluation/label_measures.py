"""Measures of labels against the truth: confusion, agreement of views, open-vocabulary names."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.sequence import FrameLabels

from .label_lists import BACKGROUND, VOID, LabelSet, place_of_object

NEAREST_M = 0.05  # in front of the second camera
SAME_SURFACE = 0.02  # difference of depths, of the depth

MIN_SHARE = 0.005  # of the pixels of a view: an object smaller than that need not be found


@dataclass(frozen=True, eq=False, slots=True)
class Correspondences:
    """Pixels [M] of two views that show the same place, as indices into their rows end to end."""

    first: np.ndarray
    second: np.ndarray


@dataclass(frozen=True, slots=True)
class Agreement:
    """Pixels of pairs of views."""

    same: int = 0  # an object in either, and by the same name in both
    objects: int = 0  # an object in either

    def __add__(self, other: "Agreement") -> "Agreement":
        return Agreement(self.same + other.same, self.objects + other.objects)

    @property
    def share(self) -> float:
        """NaN where nothing is an object: background alone would always agree."""
        return self.same / self.objects if self.objects else float("nan")


def correspondences(
    first: RgbdFrame, second: RgbdFrame, T_second_first: np.ndarray
) -> Correspondences:
    """Where the pixels of one view are in another one.

    T_second_first  [4, 4], from camera to camera

    A pixel goes where its measured depth and the poses say, to the nearest pixel of the second
    view, and counts if the depth measured there is its own to 2 %: the same surface.
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
    """Of two images of labels [H, W]; 0 is background."""
    here, there = first.ravel()[pixels.first], second.ravel()[pixels.second]
    objects = (here > 0) | (there > 0)
    return Agreement(int(np.sum((here == there) & objects)), int(np.sum(objects)))


@dataclass(frozen=True, slots=True)
class DetectionCounts:
    """right of `wanted` that there are, and of `named` that are said to be."""

    right: int = 0
    wanted: int = 0
    named: int = 0

    def __add__(self, other: "DetectionCounts") -> "DetectionCounts":
        return DetectionCounts(
            self.right + other.right, self.wanted + other.wanted, self.named + other.named
        )

    @property
    def recall(self) -> float:
        return self.right / self.wanted if self.wanted else float("nan")

    @property
    def precision(self) -> float:
        return self.right / self.named if self.named else float("nan")


class OpenNames:
    """Counts pixels, and what the pixels of each true object are shown as, view by view.

    An object is called what most of its pixels are, over all views in which it has 0.5 % of the
    pixels. What a data set has as an instance is an object here, be it a part of the building: a
    wall can be called by a wrong name.
    """

    def __init__(self, labels: LabelSet, map_names: Sequence[str]) -> None:
        """`labels` is the full list of a data set, `map_names` are by label of the map."""
        self.pixels = DetectionCounts()
        self._of_map = labels.of_map(map_names)
        self._is_named = _table(map_names)
        self._is_wanted = _table(labels.names)
        self._votes: dict[int, np.ndarray] = {}  # [256] pixels by label of the map, by instance
        self._truth: dict[int, int] = {}  # index in the list, by instance

    def add(self, frame: FrameLabels, truth: np.ndarray, shown: np.ndarray) -> None:
        """truth [H, W] uint8, index in the list or VOID; shown [H, W] uint8, label of the map."""
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
        called = {instance: int(votes.argmax()) for instance, votes in self._votes.items()}
        named = [instance for instance, label in called.items() if self._is_named[label]]
        right = [i for i in named if self._of_map[called[i]] == self._truth[i]]
        wanted = [truth for truth in self._truth.values() if self._is_wanted[truth]]
        return DetectionCounts(len(right), len(wanted), len(named))


def is_beyond_coco(name: str) -> bool:
    """Whether it is the name of an object that COCO has no class for."""
    return place_of_object(name) not in (BACKGROUND, "other", *COCO)


def _table(names: Sequence[str]) -> np.ndarray:
    """[256] bool, by index."""
    table = np.zeros(256, bool)
    table[: len(names)] = [is_beyond_coco(name) for name in names]
    return table


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
