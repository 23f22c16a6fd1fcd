"""Comparison of true labels with the labels of a map, rendered at the poses of frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service import datasets
from ldo_service.errors import DataError
from ldo_service.gaussians.renderer import render
from ldo_service.geometry import RgbdFrame, Trajectory, se3
from ldo_service.geometry.sequence import FrameLabels
from ldo_service.semantics.semantic_fusion import label_image
from ldo_service.semantics.semantics_file import SavedSemantics

from .finished_run import FinishedRun, PosedMap, RunFrame
from .instances import InstanceEvaluator, InstancePrecision, SavedObjects
from .label_lists import LabelSet, coco_list, full_list, object_labels
from .label_measures import (
    Agreement,
    Correspondences,
    DetectionCounts,
    OpenNames,
    Segmentation,
    agreement,
    confusion,
    correspondences,
    segmentation,
)
from .views import EvaluatedFrames

APART = 3  # Difference of the frame indices of the two views of a pair.
GATES = {"from 0.2 %": 0.002, "all": 0.0}  # Minimum fraction of pixels of an evaluated class.
# Maximum difference between the stamps of a frame and of its true pose, as for trajectories.
SAME_STAMP_S = 0.02

PROTOCOL = """\
Labels are rendered for the frames of A and B above, at the same poses. A pixel has the label s with
the largest sum_i w_i p_i(s) over its Gaussians i. Pixels of all frames are pooled. Pixels without a
true label are ignored. A name of the map that is not in the list is always wrong.
COCO: the list of background and the COCO classes of the source, by detection/synonyms.yaml; all
other classes are background. All names: the list of background (wall, floor, ceiling) and every
object name of the source; an object with a COCO class has the name of that class. Option --classes:
the list of background and the classes of a file. A class that is not in the list counts as a listed
class with the same COCO class; pixels of all other classes are ignored.
mIoU, accuracy and IoU by frequency are means over classes. They are given twice: for the classes
with more than 0.2 % of the pixels, and for all that occur. Pixel accuracy is over all pixels. Per
image: mIoU over the classes of a frame, averaged over the frames.
Consistency: fraction of equal labels in two frames 3 apart, among the pixels that show an object in
at least one of them. Pixels correspond by measured depth and true poses, or by the run's final
poses if no true poses are known.
Beyond COCO: objects whose name has no COCO class, in frames where they have 0.5 % of the pixels.
The map's name of an object is the name of most of its pixels. Recall is over the objects with such
a true name, precision over the objects with such a name in the map. The next line counts pixels
instead of objects.
Instances: a pixel belongs to an object of the map if it has the label of the object and its surface
is in the object's box, with a margin of 5 cm. The pixels of all frames are joined by object, and by
true instance. A found object is right if its IoU with a true instance of its class is above 0.5
(AP50), 0.25 (AP25), or 0.5 to 0.9 in steps of 0.05 (AP, the mean). AP is the area under the curve
of precision over recall; the objects are sorted by the probability of their name. It is the mean
over the classes with true instances. Instances with fewer pixels over all frames than 0.5 % of an
image are left out."""


@dataclass(frozen=True, eq=False, slots=True)
class ListErrors:
    """Label errors of a map, evaluated with one list of label names.

    Attributes:
        labels: The list of C label names.
        frames: Indices of the evaluated frames in the sequence.
        confusions: Confusion matrix [C, C + 1] of each frame, see `label_measures.confusion`.
        instances: Average precision of the objects of the map, by name of a class with a true
            instance; None if the run did not save objects.
    """

    labels: LabelSet
    frames: tuple[int, ...]
    confusions: tuple[np.ndarray, ...]
    instances: dict[str, InstancePrecision] | None = None

    @property
    def pooled(self) -> np.ndarray:
        """Sum of the confusion matrices of all frames, [C, C + 1]."""
        return np.sum(self.confusions, axis=0)

    def figures(self, gate: float) -> Segmentation:
        """Return the metrics of all pixels of all frames together.

        Args:
            gate: A class enters the means over classes if its fraction of all true pixels exceeds
                this value, 0..1; see `label_measures.segmentation`.
        """
        return segmentation(self.pooled, gate)

    def per_image_iou(self) -> float:
        """Compute the mean IoU of each frame and return the average; NaN without frames."""
        ious = [segmentation(counts).mean_iou for counts in self.confusions]
        return float(np.nanmean(ious)) if np.any(np.isfinite(ious)) else float("nan")


@dataclass(frozen=True, eq=False, slots=True)
class LabelErrors:
    """Errors of the labels of one map."""

    map: str  # Name of the map, such as "online" or "refined".
    lists: tuple[ListErrors, ...]  # Errors for each list of label names.
    consistency: Agreement  # Agreement of the map's labels between the frames of a pair.
    pairs: int  # Number of frame pairs compared for consistency.
    objects: DetectionCounts  # Objects whose name has no COCO class.
    pixels: DetectionCounts  # Pixels whose name has no COCO class.


@dataclass(frozen=True, eq=False, slots=True)
class LabelView:
    """A frame with its true labels and the labels rendered from the map.

    Attributes:
        frame: The frame.
        truth: True labels of the frame.
        shown: Labels of the map, [H, W] uint8.
        objects: Object of each pixel, [H, W] int32, see `instances.SavedObjects.image`; None if the
            run did not save objects.

    Raises:
        DataError: If the true labels have another size than the frame.
    """

    frame: RgbdFrame
    truth: FrameLabels
    shown: np.ndarray
    objects: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not self.truth.class_ids.shape == self.truth.instance_ids.shape == self.shown.shape:
            raise DataError(
                f"the true labels of frame {self.frame.index} have the shapes "
                f"{self.truth.class_ids.shape} (classes) and {self.truth.instance_ids.shape} "
                f"(instances), expected {self.shown.shape}, the shape of the frame. Export the "
                "labels at the size of the frames."
            )


class MapLabels:
    """Renderer of the labels of a map."""

    def __init__(
        self, sequence: datasets.Sequence, posed: PosedMap, saved: SavedSemantics, threads: int
    ) -> None:
        self.name, self.names = posed.name, saved.names
        self.objects = posed.objects
        self._sequence, self._posed, self._saved = sequence, posed, saved
        self._threads = threads

    def image(self, frame: RunFrame) -> np.ndarray:
        """Render the labels at the pose of a frame, [H, W] uint8.

        Raises:
            DataError: If the frame has no pose.
        """
        return self.images(frame)[0]

    def images(self, frame: RunFrame) -> tuple[np.ndarray, np.ndarray | None]:
        """Render the labels and the objects at the pose of a frame.

        Returns:
            Label of each pixel, [H, W] uint8, and object of each pixel, [H, W] int32. The second
            image is None if the run did not save objects.

        Raises:
            DataError: If the frame has no pose.
        """
        rows, camera, threads = self._posed.rows, self._sequence.camera, self._threads
        T_map_camera = self._posed.T_map_camera(frame)
        at = camera, se3.inverse(T_map_camera)
        made = render(rows, *at, threads=threads, contributions=True)
        labels = label_image(rows, self._saved.labels, made, *at, threads=threads)
        if self.objects is None:
            return labels, None
        depth_m = made.median_depth_m
        return labels, self.objects.image(labels, depth_m, camera, T_map_camera, self.names)


class LabelEvaluator:
    """Accumulator of the label errors of one map, to which views are added one by one."""

    def __init__(
        self,
        map_names: Sequence[str],
        class_names: Sequence[str],
        classes: LabelSet | None = None,
        objects: SavedObjects | None = None,
    ) -> None:
        self._class_names = class_names
        self._instances = None if objects is None else InstanceEvaluator(objects)
        more = () if classes is None else (classes,)
        self._lists = (coco_list(class_names), full_list(class_names), *more)
        self._tables = [(x.of_truth(class_names), x.of_map(map_names)) for x in self._lists]
        self._confusions: list[list[np.ndarray]] = [[] for _ in self._lists]
        self._frames: list[int] = []
        self._open = OpenNames(self._lists[1], map_names)
        self._objects = object_labels(map_names)
        self._agreement, self._pairs = Agreement(), 0

    def see(self, view: LabelView) -> None:
        """Add the label errors of a view."""
        self._frames.append(view.frame.index)
        for labels, tables, seen in zip(self._lists, self._tables, self._confusions, strict=True):
            truth, shown = tables[0][view.truth.class_ids], tables[1][view.shown]
            seen.append(confusion(truth, shown, len(labels.names)))
        self._open.add(view.truth, self._tables[1][0][view.truth.class_ids], view.shown)
        if self._instances is not None and view.objects is not None:
            self._instances.see(view.truth, view.objects)

    def compare(self, first: np.ndarray, second: np.ndarray, pixels: Correspondences) -> None:
        """Add the agreement of the map's labels between two views, for the consistency score.

        Args:
            first: Labels of the map in the first view, [H, W].
            second: Labels of the map in the second view, [H, W].
            pixels: Corresponding pixels of the views.
        """
        images = self._objects[first], self._objects[second]
        self._agreement += agreement(*images, pixels)
        self._pairs += 1

    def errors(self, name: str) -> LabelErrors:
        """Return the errors over all views; `name` is the name of the map in the result."""
        lists = (
            ListErrors(labels, tuple(self._frames), tuple(confusions), self._precision(labels))
            for labels, confusions in zip(self._lists, self._confusions, strict=True)
        )
        found = self._open.objects, self._open.pixels
        return LabelErrors(name, tuple(lists), self._agreement, self._pairs, *found)

    def _precision(self, labels: LabelSet) -> dict[str, InstancePrecision] | None:
        return self._instances and self._instances.precision(labels, self._class_names)


def evaluate_labels(
    sequence: datasets.Sequence,
    run: FinishedRun,
    judged: EvaluatedFrames,
    advance: Callable[[int], None],
    *,
    classes: LabelSet | None = None,
    threads: int = 1,
) -> list[LabelErrors]:
    """Evaluate the labels of each labelled map.

    Args:
        sequence: Source with the true labels.
        run: The run.
        judged: Frames to evaluate.
        advance: Progress function, called with the number of frames done so far.
        classes: List of classes to evaluate in addition to COCO and all names; None for no list.
        threads: Threads of the renderer.

    Returns:
        Errors of each labelled map; empty if the run has no labels, or the source has no true
        labels.

    Raises:
        DataError: If a frame has no true labels or no pose.
    """
    labels, maps = sequence.true_labels(), labelled_maps(sequence, run, threads)
    if labels is None or not maps:
        return []
    judges = [LabelEvaluator(m.names, labels.class_names, classes, m.objects) for m in maps]
    pairs = Pairs(sequence, run)
    for done, frame in enumerate(judged.posed, 1):
        image, truth = sequence[frame.index], labels.frame(frame.index)
        other, pixels = pairs.of(frame, image)
        for map_, judge in zip(maps, judges, strict=True):
            shown, objects = map_.images(frame)
            judge.see(LabelView(image, truth, shown, objects))
            if other is not None and pixels is not None:
                judge.compare(shown, map_.image(other), pixels)
        advance(done)
    return [judge.errors(map_.name) for map_, judge in zip(maps, judges, strict=True)]


def labelled_maps(
    sequence: datasets.Sequence, run: FinishedRun, threads: int = 1
) -> list[MapLabels]:
    """Return a label renderer for each labelled map of a run."""
    return [
        MapLabels(sequence, posed, posed.semantics, threads)
        for posed in run.maps
        if posed.semantics is not None
    ]


class Pairs:
    """Frame pairs for label consistency: two frames with poses, three frame indices apart."""

    def __init__(self, sequence: datasets.Sequence, run: FinishedRun) -> None:
        self._sequence = sequence
        self._by_index = {frame.index: frame for frame in run.frames if not frame.is_lost}
        self._known = sequence.truth() or run.estimates["final"]

    def of(
        self, frame: RunFrame, image: RgbdFrame
    ) -> tuple[RunFrame | None, Correspondences | None]:
        """Find the second frame of a pair, and the corresponding pixels, from its first frame.

        Args:
            frame: The first frame.
            image: Color and depth of the first frame.

        Returns:
            The frame whose index is three higher, and the corresponding pixels of the two frames.
            Both results are None if there is no such frame, or if a frame of the pair has no pose.
        """
        other = self._by_index.get(frame.index + APART)
        T_first = _at(self._known, frame.stamp_ns)
        T_second = None if other is None else _at(self._known, other.stamp_ns)
        if other is None or T_first is None or T_second is None:
            return None, None
        T_second_first = se3.inverse(T_second) @ T_first
        return other, correspondences(image, self._sequence[other.index], T_second_first)


def _at(known: Trajectory, stamp_ns: int) -> np.ndarray | None:
    gaps_s = np.abs(known.stamps_s - stamp_ns * 1e-9)
    is_known = len(gaps_s) > 0 and gaps_s.min() <= SAME_STAMP_S
    return known.T_world_camera[gaps_s.argmin()] if is_known else None
