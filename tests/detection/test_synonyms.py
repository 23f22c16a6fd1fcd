"""Other words for the classes of COCO."""

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


def test_the_table_is_about_classes_of_coco_and_each_word_stands_once() -> None:
    assert set(TABLE) <= set(COCO)
    assert {column for row in TABLE.values() for column in row} == {"same", "kinds"}
    assert len(WORDS) == len(set(WORDS))
    assert not set(WORDS) & set(COCO)
    assert [word for word in WORDS if normalized(word) != word] == []


@pytest.mark.parametrize("name", ["TV-screen", "tv_screen", "  Tv   Screen "])
def test_case_spaces_hyphens_and_underscores_do_not_matter(name: str) -> None:
    assert normalized(name) == "tv screen"
    assert canonical(name) == "tv"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sofa", "couch"),
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
def test_names_of_data_sets_lead_to_the_class_of_coco_or_to_none(name, expected) -> None:
    assert coco_class(name) == expected


def test_who_asks_for_a_class_finds_its_kinds_and_the_other_way_round() -> None:
    assert answers_to("Sofa") == ("couch",)
    assert answers_to("desk") == ("desk", "dining table")
    assert answers_to("chair")[0] == "chair"
    assert "office chair" in answers_to("chair")
    assert answers_to("fire-extinguisher") == ("fire extinguisher",)


def test_the_names_that_other_detectors_use_are_those_of_coco() -> None:
    """As of Pascal VOC: sofa, tvmonitor, diningtable."""
    folder = os.environ.get("LDO_WEIGHTS")
    if not folder:
        pytest.skip("set LDO_WEIGHTS to a folder with coco_classes.txt")
    names = read_names(Path(folder) / "coco_classes.txt")
    assert names != COCO
    assert tuple(map(canonical, names)) == COCO
