import pytest

from ldo_service.errors import DataError
from ldo_service.evaluation.label_lists import (
    UNKNOWN,
    VOID,
    coco_list,
    full_list,
    object_labels,
)
from ldo_service.synthetic.flat import CLASS_NAMES

SOURCE = ("undefined", "wall", "sofa", "desk", "table", "cushion", "fire-extinguisher")
MAP = ("background", "other", "couch", "dining table", "fire extinguisher", "person", "wall")


def named(labels, table, names) -> dict[str, str]:
    special = {VOID: "void", UNKNOWN: "unknown"}
    ids = (int(table[k]) for k in range(len(names)))
    return {
        name: special.get(label) or labels.names[label]
        for name, label in zip(names, ids, strict=True)
    }


def test_coco_list_maps_synonyms_and_puts_the_rest_into_background() -> None:
    labels = coco_list(SOURCE)
    assert labels.names == ("background", "couch", "dining table")
    assert named(labels, labels.of_truth(SOURCE), SOURCE) == {
        "undefined": "void",
        "wall": "background",
        "sofa": "couch",
        "desk": "dining table",
        "table": "dining table",
        "cushion": "background",
        "fire-extinguisher": "background",
    }
    assert named(labels, labels.of_map(MAP), MAP) == {
        "background": "background",
        "other": "unknown",
        "couch": "couch",
        "dining table": "dining table",
        "fire extinguisher": "background",
        "person": "unknown",
        "wall": "background",
    }


def test_full_list_has_every_object_and_no_parts_of_the_building() -> None:
    labels = full_list(SOURCE)
    assert labels.names == ("background", "couch", "dining table", "cushion", "fire extinguisher")
    of_map = named(labels, labels.of_map(MAP), MAP)
    assert of_map["fire extinguisher"] == "fire extinguisher"
    assert of_map["other"] == of_map["person"] == "unknown"
    assert of_map["wall"] == "background"


def test_collective_classes_of_nyu40_are_ignored() -> None:
    source = ("", "chair", "otherprop", "otherfurniture", "otherstructure")
    for labels in (coco_list(source), full_list(source)):
        assert labels.names == ("background", "chair")
        assert labels.of_truth(source)[:5].tolist() == [VOID, 1, VOID, VOID, VOID]


def test_ids_beyond_the_names_are_void_in_truth_and_unknown_in_a_map() -> None:
    labels = full_list(SOURCE)
    assert set(labels.of_truth(SOURCE)[len(SOURCE) :]) == {VOID}
    assert set(labels.of_map(MAP)[len(MAP) :]) == {UNKNOWN}


def test_the_flat_has_23_names_beyond_coco_and_three_of_the_building() -> None:
    coco, full = coco_list(CLASS_NAMES), full_list(CLASS_NAMES)
    assert (len(coco.names), len(full.names)) == (1 + 80, 1 + 80 + 23)


def test_parts_of_the_building_are_no_objects() -> None:
    assert object_labels(MAP)[: len(MAP)].tolist() == [0, 1, 2, 3, 4, 5, 0]


def test_more_names_than_an_image_can_hold_are_an_error() -> None:
    with pytest.raises(DataError, match="at most 254"):
        full_list([f"thing {k}" for k in range(254)])
