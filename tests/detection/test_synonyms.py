"""Synonyms of the COCO classes."""

import os
from pathlib import Path

import pytest
import yaml

from ldo_service.detection import vocabulary
from ldo_service.detection.vocabulary import (
    COCO,
    answers_to,
    canonical,
    coco_class,
    normalized,
    read_names,
)

TABLE = yaml.safe_load((Path(vocabulary.__file__).parent / vocabulary.TABLE).read_text())
WORDS = [word for row in TABLE.values() for words in row.values() for word in words]


def test_synonyms_map_to_coco_classes_and_are_unique() -> None:
    assert set(TABLE) <= set(COCO)
    assert {column for row in TABLE.values() for column in row} == {"same", "kinds"}
    assert len(WORDS) == len(set(WORDS))
    assert not set(WORDS) & set(COCO)
    assert [word for word in WORDS if normalized(word) != word] == []


@pytest.mark.parametrize("name", ["TV-screen", "tv_screen", "  Tv   Screen "])
def test_names_are_normalized(name: str) -> None:
    assert normalized(name) == "tv screen"
    assert canonical(name) == "tv"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sofa", "couch"),
        ("bed sheet", "bed"),
        ("computer-keyboard", "keyboard"),
        ("indoor-plant", "potted plant"),
        ("remote-control", "remote"),
        ("monitor", "tv"),
        ("desk", "dining table"),
        ("chair", "chair"),
        ("cushion", None),
        ("tv-stand", None),
        ("plant-stand", None),
        ("base-cabinet", None),
        ("background", None),
    ],
)
def test_coco_class_of_data_set_names(name, expected) -> None:
    assert coco_class(name) == expected


def test_answers_to_includes_subclasses_and_superclass() -> None:
    assert answers_to("Sofa") == ("couch",)
    assert answers_to("desk") == ("desk", "dining table")
    assert answers_to("chair")[0] == "chair"
    assert "office chair" in answers_to("chair")
    assert answers_to("fire-extinguisher") == ("fire extinguisher",)


def test_names_of_other_detectors_are_coco_classes() -> None:
    """Names of Pascal VOC such as sofa, tvmonitor and diningtable."""
    folder = os.environ.get("LDO_WEIGHTS")
    if not folder:
        pytest.skip("set LDO_WEIGHTS to a folder with coco_classes.txt")
    names = read_names(Path(folder) / "coco_classes.txt")
    assert names != COCO
    assert tuple(map(canonical, names)) == COCO
