"""Average precision of instances, compared with a reference and with values computed by hand."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from ldo_service.evaluation.instances import (
    AP_IOUS,
    MARGIN_M,
    NO_OBJECT,
    InstanceEvaluator,
    InstanceOverlaps,
    InstancePrecision,
    SavedObjects,
    area_under_curve,
    average_precision,
    class_precision,
    mean_precision,
)
from ldo_service.evaluation.label_lists import coco_list, full_list
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.sequence import FrameLabels

CLASSES = ("undefined", "wall", "chair", "sofa", "globe")
UNDEFINED, WALL, CHAIR, SOFA, GLOBE = range(5)
MIN_PIXELS = 3


@dataclass(frozen=True)
class Instance:
    """Set of pixels with a class and, if it was found, a confidence."""

    kind: int
    pixels: frozenset[int]
    confidence: float = 1.0


def span(kind: int, first: int, last: int, confidence: float = 1.0) -> Instance:
    """Return an instance with the pixels from `first` to `last`, `last` excluded."""
    return Instance(kind, frozenset(range(first, last)), confidence)


def overlaps(
    true: Sequence[Instance], found: Sequence[Instance], ignored: Sequence[int] = ()
) -> InstanceOverlaps:
    def sizes(instances: Sequence[Instance]) -> np.ndarray:
        return np.array([len(one.pixels) for one in instances], int)

    shared = [[len(t.pixels & f.pixels) for f in found] for t in true]
    return InstanceOverlaps(
        np.array([one.kind for one in true], int),
        sizes(true),
        np.array([one.kind for one in found], int),
        sizes(found),
        np.array([one.confidence for one in found], float),
        np.array(shared, int).reshape(len(true), len(found)),
        np.array([len(one.pixels & set(ignored)) for one in found], int),
    )


# --- reference ------------------------------------------------------------------------------------
def reference_precision(
    true: list[Instance], found: list[Instance], ignored: set[int], least: float
) -> float:
    """Return the average precision of one class, written down from the definition by sets.

    The area is the sum of trapezoids under the points (recall, precision), one for each confidence.
    """
    large = [t for t in true if len(t.pixels) >= MIN_PIXELS]
    nowhere = ignored.union(*(t.pixels for t in true if t not in large))
    found = [f for f in found if len(f.pixels) >= MIN_PIXELS]
    right: list[float] = []
    wrong: list[float] = []
    used: list[Instance] = []
    for t in large:
        candidates = [f for f in found if iou(t, f) > least and f not in used]
        if candidates:
            used.append(candidates[0])
            best, *others = sorted((f.confidence for f in candidates), reverse=True)
            right.append(best)
            wrong += others
    for f in found:
        is_alone = all(iou(t, f) <= least for t in true)
        if is_alone and len(f.pixels & nowhere) / len(f.pixels) <= least:
            wrong.append(f.confidence)
    points = [(0.0, 1.0)]
    for threshold in sorted({*right, *wrong}, reverse=True):
        tp = sum(score >= threshold for score in right)
        fp = sum(score >= threshold for score in wrong)
        points.append((tp / len(large), tp / (tp + fp)))
    recalls, precisions = np.array(points).T
    return float(np.trapezoid(precisions, recalls))


def iou(a: Instance, b: Instance) -> float:
    return len(a.pixels & b.pixels) / len(a.pixels | b.pixels)


def random_scene(seed: int) -> tuple[list[Instance], list[Instance], set[int]]:
    """Return true instances, found instances that may overlap each other, and ignored pixels."""
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.choice(np.arange(1, 60), 7, replace=False))
    true = [span(int(rng.integers(2)), a, b) for a, b in pairwise(edges.tolist())]
    found = []
    for _ in range(rng.integers(0, 12)):
        first = int(rng.integers(0, 55))
        confidence = float(rng.choice([0.2, 0.5, 0.5, 0.9]))
        found.append(
            span(int(rng.integers(2)), first, first + int(rng.integers(1, 15)), confidence)
        )
    ignored = set(range(60)) - set().union(*(t.pixels for t in true))
    return true, list({f.pixels: f for f in found}.values()), ignored


def test_precision_equals_the_reference_on_random_instances() -> None:
    values = []
    for seed in range(400):
        true, found, ignored = random_scene(seed)
        measured = class_precision(overlaps(true, found, sorted(ignored)), MIN_PIXELS)
        kinds = {t.kind for t in true if len(t.pixels) >= MIN_PIXELS}
        assert measured.keys() == kinds
        for kind in kinds:
            of_kind = (
                [one for one in true if one.kind == kind],
                [one for one in found if one.kind == kind],
            )
            aps = [reference_precision(*of_kind, ignored, least) for least in (*AP_IOUS, 0.25)]
            expected = np.mean(aps[:-1]), aps[0], aps[-1]
            one = measured[kind]
            assert (one.ap, one.ap50, one.ap25) == pytest.approx(expected, abs=1e-12)
            values.append(one.ap25)
    assert 0.1 < np.mean(values) < 0.9, "the scenes have right and wrong instances"


# --- values by hand -------------------------------------------------------------------------------
def ap50(true: Sequence[Instance], found: Sequence[Instance], ignored: Sequence[int] = ()) -> float:
    return class_precision(overlaps(true, found, ignored), MIN_PIXELS)[true[0].kind].ap50


def test_found_instance_counts_if_its_iou_exceeds_the_threshold() -> None:
    true = [span(0, 0, 10)]
    assert ap50(true, [span(0, 0, 10)]) == 1
    assert ap50(true, [span(0, 0, 6)]) == 1, "IoU 0.6"
    assert ap50(true, [span(0, 0, 5)]) == 0, "an IoU of exactly 0.5 does not exceed it"
    assert ap50(true, [span(1, 0, 10)]) == 0, "another class"
    assert ap50(true, []) == 0


def test_precision_depends_on_the_order_of_confidences() -> None:
    true, right = [span(0, 0, 10), span(0, 20, 30)], span(0, 0, 10, 0.9)
    assert ap50(true, [right]) == 0.5, "one of two"
    assert ap50(true, [right, span(0, 40, 50, 0.1)]) == 0.5, "a later error costs nothing"
    # Precision rises from 0 to 1/2 while recall rises from 0 to 1/2.
    assert ap50(true, [right, span(0, 40, 50, 1.0)]) == 0.5 * (0 + 0.5) / 2


def test_equal_confidences_are_one_point_of_the_curve() -> None:
    true, found = [span(0, 0, 10)], [span(0, 0, 10, 0.7), span(0, 40, 50, 0.7)]
    # The curve has the points (0, 1) and (1, 1/2), in either order of the found instances.
    assert ap50(true, found) == ap50(true, found[::-1]) == 0.75
    assert area_under_curve([(0.7, False), (0.7, True)], 1) == 0.75


def test_second_match_of_a_true_instance_is_wrong() -> None:
    """Two found instances can match one true instance at a threshold of 0.25."""
    true, halves = [span(0, 0, 10)], [span(0, 0, 5, 0.4), span(0, 5, 10, 0.8)]
    of_class = overlaps(true, halves)
    assert average_precision(of_class, 0.25, MIN_PIXELS) == 1, "the wrong one has less confidence"
    assert average_precision(of_class, 0.5, MIN_PIXELS) == 0
    equal = overlaps(true, [span(0, 0, 5, 0.8), span(0, 5, 10, 0.8)])
    assert average_precision(equal, 0.25, MIN_PIXELS) == 0.75


def test_found_instance_matches_one_true_instance_only() -> None:
    of_class = overlaps([span(0, 0, 5), span(0, 5, 10)], [span(0, 0, 10)])
    assert average_precision(of_class, 0.25, MIN_PIXELS) == 0.5


def test_small_true_instances_are_neither_wanted_nor_wrong() -> None:
    small, large = span(0, 0, 2), span(0, 10, 20, 0.5)
    sure = span(0, 0, 3, 0.9)
    assert ap50([large, small], [large]) == 1, "it is not wanted"
    assert ap50([large, small], [large, sure]) == 1, "to find it is not wrong"
    assert ap50([large, span(1, 0, 2)], [large, sure]) < 1, "its class is another one"
    assert ap50([large], [large, span(0, 30, 32, 0.9)]) == 1, "a small found one is left out"
    assert class_precision(overlaps([small], [sure]), MIN_PIXELS) == {}


def test_found_instance_on_ignored_pixels_is_not_wrong() -> None:
    true = [span(0, 10, 20, 0.5)]
    found = [*true, span(0, 30, 40, 0.9)]
    assert ap50(true, found, range(30, 36)) == 1, "60 % are ignored"
    assert ap50(true, found, range(30, 35)) == 0.25, "half are ignored, and more would be needed"


def test_mean_is_over_the_classes_with_true_instances() -> None:
    true = [span(0, 0, 10), span(1, 20, 30)]
    found = class_precision(overlaps(true, [span(0, 0, 10), span(2, 40, 50)]), MIN_PIXELS)
    assert found == {0: InstancePrecision(1, 1, 1), 1: InstancePrecision(0, 0, 0)}
    names = {"a": found[0], "b": found[1]}
    assert mean_precision(names) == InstancePrecision(0.5, 0.5, 0.5)
    assert np.isnan(mean_precision({}).ap50)


# --- pixels of several views ----------------------------------------------------------------------
def saved(*names: str, x_m: Sequence[float] | None = None) -> SavedObjects:
    """Return objects with cubes of 0.4 m at the depth 2 m, at the given positions."""
    T = np.tile(np.eye(4), (len(names), 1, 1))
    T[:, 0, 3] = np.arange(len(names)) if x_m is None else x_m
    T[:, 2, 3] = 2.0
    return SavedObjects(names, np.full(len(names), 0.9), T, np.full((len(names), 3), 0.4))


def row(*values: int) -> np.ndarray:
    return np.repeat(np.array([values]), 4, axis=1)


def view(classes: np.ndarray, instances: np.ndarray) -> FrameLabels:
    return FrameLabels(classes.astype(np.uint8), instances.astype(np.uint16))


def test_pixels_of_all_views_are_joined_by_object() -> None:
    evaluator = InstanceEvaluator(saved("chair"))
    evaluator.see(view(row(WALL, CHAIR), row(0, 7)), row(-1, 0))
    evaluator.see(view(row(CHAIR, CHAIR), row(7, 7)), row(0, -1))
    found = evaluator.overlaps(full_list(CLASSES), CLASSES)
    assert found.true_pixels.tolist() == [12]
    assert found.found_pixels.tolist() == [8]
    assert found.shared.tolist() == [[8]]
    aps = evaluator.precision(full_list(CLASSES), CLASSES)["chair"]
    assert (aps.ap50, aps.ap25) == (1, 1)
    assert aps.ap == pytest.approx(4 / 9), "an IoU of 2/3 exceeds 0.5, 0.55, 0.6 and 0.65"


def test_classes_of_a_list_decide_which_instances_count() -> None:
    evaluator = InstanceEvaluator(saved("couch", "globe", "kite"))
    evaluator.see(
        view(row(SOFA, GLOBE, WALL, UNDEFINED, CHAIR), row(3, 4, 5, 6, 0)), row(0, 1, 2, 1, 1)
    )
    full, coco = (evaluator.overlaps(names(CLASSES), CLASSES) for names in (full_list, coco_list))
    listed = full_list(CLASSES).names
    assert [listed[k] for k in full.true_classes] == ["couch", "globe"], "a wall is no instance"
    assert full.ignored.tolist() == [0, 8, 0], "undefined pixels, and a chair that is no instance"
    assert len(coco.true_classes) == 1, "COCO has no globe"
    assert evaluator.precision(full_list(CLASSES), CLASSES).keys() == {"couch", "globe"}
    assert evaluator.precision(full_list(CLASSES), CLASSES)["couch"].ap == 1


def test_instances_below_half_a_percent_of_an_image_are_left_out() -> None:
    shape, evaluator = (40, 50), InstanceEvaluator(saved("chair", "couch"))
    classes, instances, shown = (np.full(shape, value) for value in (WALL, 0, NO_OBJECT))
    classes[0, :9], instances[0, :9], shown[0, :9] = CHAIR, 1, 0
    classes[1, :10], instances[1, :10], shown[1, :10] = SOFA, 2, 1
    evaluator.see(view(classes, instances), shown)
    assert evaluator.min_pixels == 10
    assert evaluator.precision(full_list(CLASSES), CLASSES).keys() == {"couch"}


# --- objects of pixels ----------------------------------------------------------------------------
CAMERA = Camera(width=41, height=3, fx=20.0, fy=20.0, cx=20.0, cy=1.0)
NAMES = ("background", "other", "chair", "couch")


def objects_at(objects: SavedObjects, labels: np.ndarray, depth_m: float = 2.0) -> np.ndarray:
    """Return the objects of the middle row; neighboring pixels are 0.1 m apart at 2 m."""
    depth = np.full(labels.shape, depth_m, np.float32)
    return objects.image(labels, depth, CAMERA, np.eye(4), NAMES)[1]


def test_pixel_belongs_to_the_box_with_its_label() -> None:
    labels = np.full((3, 41), 2, np.uint8)
    found = objects_at(saved("chair", "couch", x_m=[-0.5, 1.0]), labels)
    # The box is 0.4 m wide and has a margin of 5 cm: offsets of 0.2 m are in, 0.3 m are out.
    assert np.flatnonzero(found == 0).tolist() == [13, 14, 15, 16, 17]
    assert np.all(found[found != 0] == NO_OBJECT), "the couch has no pixel with its label"
    labels[:] = 3
    found = objects_at(saved("chair", "couch", x_m=[-0.5, 1.0]), labels)
    assert np.flatnonzero(found == 1).tolist() == [28, 29, 30, 31, 32]
    assert np.all(objects_at(saved("chair"), labels) == NO_OBJECT)


def test_surface_behind_the_box_or_missing_belongs_to_no_object() -> None:
    labels = np.full((3, 41), 2, np.uint8)
    assert objects_at(saved("chair"), labels, 2.2 + MARGIN_M - 0.01)[20] == 0
    assert objects_at(saved("chair"), labels, 2.2 + MARGIN_M + 0.01)[20] == NO_OBJECT
    in_the_box = np.eye(4)
    in_the_box[2, 3] = 2.0
    missing = np.zeros(labels.shape, np.float32)
    assert np.all(saved("chair").image(labels, missing, CAMERA, in_the_box, NAMES) == NO_OBJECT)


def test_nearest_center_decides_between_boxes_in_either_order() -> None:
    labels = np.full((3, 41), 2, np.uint8)
    for x_m in ([0.0, 0.3], [0.3, 0.0]):
        found = objects_at(saved("chair", "chair", x_m=x_m), labels)
        left, right = (int(k) for k in np.argsort(x_m))
        assert np.all(found[18:22] == left)
        assert np.all(found[22:26] == right)


def test_boxes_are_in_the_frame_of_the_map() -> None:
    labels = np.full((3, 41), 2, np.uint8)
    T_map_camera = np.eye(4)
    T_map_camera[:3, :3] = se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))[:3, :3]
    T_map_camera[:3, 3] = 5.0, 6.0, 7.0
    objects = saved("chair")
    moved = SavedObjects(
        objects.names, objects.confidences, T_map_camera @ objects.T_map_object, objects.sizes
    )
    depth = np.full(labels.shape, 2.0, np.float32)
    found = moved.image(labels, depth, CAMERA, T_map_camera, NAMES)[1]
    assert np.flatnonzero(found == 0).tolist() == [18, 19, 20, 21, 22]
