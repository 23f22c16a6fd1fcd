import numpy as np
import pytest

from ldo_service.evaluation.label_lists import full_list
from ldo_service.evaluation.label_measures import DetectionCounts, OpenNames, is_beyond_coco
from ldo_service.geometry.sequence import FrameLabels

SOURCE = ("undefined", "wall", "chair", "ladder", "globe", "fan")
MAP = ("background", "other", "chair", "ladder", "globe", "samovar")
LABELS = full_list(SOURCE)
OF_TRUTH = LABELS.of_truth(SOURCE)


def names_of(*strips: tuple[int, str, str]) -> OpenNames:
    """Return names of one view of vertical strips, 20 pixels each: instance, truth, map."""
    names = OpenNames(LABELS, MAP)
    add(names, *strips)
    return names


def add(names: OpenNames, *strips: tuple[int, str, str]) -> None:
    instances, truth, shown = (
        np.repeat([column], 20, axis=0).astype(kind)
        for column, kind in zip(
            (
                [instance for instance, _, _ in strips],
                [SOURCE.index(name) for _, name, _ in strips],
                [MAP.index(name) for _, _, name in strips],
            ),
            (np.uint16, np.uint8, np.uint8),
            strict=True,
        )
    )
    names.add(FrameLabels(truth, instances), OF_TRUTH[truth], shown)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ladder", True),
        ("fire-extinguisher", True),
        ("chair", False),
        ("desk", False),
        ("wall", False),
        ("other", False),
        ("background", False),
    ],
)
def test_names_without_a_coco_class_are_beyond_coco(name: str, expected: bool) -> None:
    assert is_beyond_coco(name) == expected


def test_object_is_named_by_most_of_its_pixels() -> None:
    names = names_of(
        *(3 * [(1, "ladder", "ladder")]),
        *(2 * [(1, "ladder", "background")]),
        *(2 * [(2, "globe", "globe")]),
        *(3 * [(2, "globe", "chair")]),
        (3, "chair", "chair"),
    )
    assert names.objects == DetectionCounts(right=1, wanted=2, named=1)
    assert names.pixels == DetectionCounts(right=100, wanted=200, named=100)


def test_counts_of_views_are_pooled() -> None:
    names = names_of((1, "ladder", "background"))
    add(names, *(2 * [(1, "ladder", "ladder")]))
    assert names.objects == DetectionCounts(1, 1, 1)
    assert names.pixels == DetectionCounts(40, 60, 40)


def test_wrong_names_of_any_kind_lower_precision() -> None:
    names = names_of(
        (1, "ladder", "ladder"),
        (2, "chair", "globe"),
        (9, "wall", "ladder"),
        (4, "fan", "samovar"),
        (5, "globe", "other"),
    )
    assert names.objects == DetectionCounts(right=1, wanted=3, named=4)
    assert names.objects.precision == 0.25
    assert names.objects.recall == pytest.approx(1 / 3)


def test_void_pixels_are_not_counted() -> None:
    names = names_of((1, "ladder", "ladder"), (7, "undefined", "globe"))
    assert names.objects == DetectionCounts(1, 1, 1)
    assert names.pixels == DetectionCounts(20, 20, 20)


def test_objects_below_the_minimum_size_are_not_counted() -> None:
    frame = FrameLabels(np.full((40, 40), 1, np.uint8), np.zeros((40, 40), np.uint16))
    frame.class_ids[0, :7] = SOURCE.index("ladder")
    frame.instance_ids[0, :7] = 1
    names, shown = OpenNames(LABELS, MAP), np.zeros((40, 40), np.uint8)
    names.add(frame, OF_TRUTH[frame.class_ids], shown)
    assert names.objects.wanted == 0
    frame.class_ids[0, 7] = SOURCE.index("ladder")
    frame.instance_ids[0, 7] = 1
    names.add(frame, OF_TRUTH[frame.class_ids], shown)
    assert names.objects.wanted == 1


def test_precision_without_names_and_recall_without_objects_are_nan() -> None:
    assert np.isnan(DetectionCounts(0, 3, 0).precision)
    assert np.isnan(DetectionCounts(0, 0, 3).recall)
