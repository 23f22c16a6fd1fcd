from pathlib import Path

import pytest

from ldo_service.errors import ConfigError, DataError
from ldo_service.evaluation.label_lists import (
    UNKNOWN,
    VOID,
    coco_list,
    full_list,
    known_lists,
    load_classes,
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


def test_lists_of_the_package_have_the_classes_of_their_benchmarks() -> None:
    """Walls, floors and ceilings are background, and collective classes are left out."""
    counts = {name: len(load_classes(name).names) - 1 for name in known_lists()}
    assert counts == {"nyu40": 40 - 3 - 3, "scannet20": 20 - 2 - 1, "replica51": 51 - 3}


def test_names_of_map_and_data_set_become_classes_of_the_list() -> None:
    labels = load_classes("nyu40")
    truth = ("", "wall", "sofa", "desk", "table", "books", "otherprop", "fire extinguisher")
    assert named(labels, labels.of_truth(truth), truth) == {
        "": "void",
        "wall": "background",
        "sofa": "couch",
        "desk": "desk",
        "table": "table",
        "books": "books",
        "otherprop": "void",
        "fire extinguisher": "void",
    }
    found = ("background", "other", "couch", "dining table", "book", "monitor", "cup")
    assert named(labels, labels.of_map(found), found) == {
        "background": "background",
        "other": "unknown",
        "couch": "couch",
        "dining table": "table",
        "book": "books",
        "monitor": "tv",
        "cup": "unknown",
    }


@pytest.mark.parametrize("name", ["nyu40", "scannet20", "replica51"])
def test_table_of_a_detector_is_a_table_in_each_list_and_spaces_are_ignored(name: str) -> None:
    labels = load_classes(name)
    found = ("dining table", "shower-curtain")
    expected = {"dining table": "table"}
    if name != "replica51":
        expected["shower-curtain"] = "shower curtain"
    assert named(labels, labels.of_map(found), found).items() >= expected.items()
    if name != "scannet20":
        stands = named(labels, labels.of_map(("nightstand", "night stand")), ("a", "b"))
        assert stands["a"] == stands["b"] in ("nightstand", "night stand")


def test_list_of_a_file_is_read_and_a_missing_one_names_the_known_lists(tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    path.write_text("floor\nSofa\ncouch\nfire-extinguisher\n")
    labels = load_classes(str(path))
    assert (labels.name, labels.names) == ("mine", ("background", "couch", "fire extinguisher"))
    with pytest.raises(ConfigError, match="nyu40, replica51, scannet20"):
        load_classes("nyu41")
    path.write_text("floor\n")
    with pytest.raises(ConfigError, match="has 0 names of objects"):
        load_classes(str(path))
    coco = tmp_path / "COCO.txt"
    coco.write_text("sofa\n")
    with pytest.raises(ConfigError, match="Give it another name"):
        load_classes(str(coco))
