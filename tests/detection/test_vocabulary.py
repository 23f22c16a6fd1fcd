"""Vocabulary of names with constant indices."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldo_service.detection.vocabulary import BACKGROUND, COCO, OTHER, Vocabulary
from ldo_service.errors import ConfigError
from ldo_service.synthetic.flat.scene_object import CLASS_NAMES, COCO_COUNT


def test_vocabulary_starts_with_background_other_and_coco() -> None:
    vocabulary = Vocabulary()
    assert vocabulary.names == ("background", "other", *COCO)
    assert (vocabulary.index("background"), vocabulary.index("other")) == (BACKGROUND, OTHER)
    assert CLASS_NAMES[:COCO_COUNT] == COCO, "equal to the names of the synthetic flat"
    assert len(set(COCO)) == 80


def test_new_names_get_constant_consecutive_indices() -> None:
    vocabulary = Vocabulary()
    assert vocabulary.find("fire extinguisher") is None
    assert vocabulary.index("Fire_Extinguisher") == 82
    assert vocabulary.index("globe") == 83
    assert vocabulary.index(" fire-extinguisher ") == 82
    assert vocabulary.name(82) == "fire extinguisher"
    assert "GLOBE" in vocabulary


def test_synonyms_share_an_index() -> None:
    vocabulary = Vocabulary()
    assert vocabulary.index("Sofa") == vocabulary.index("couch") == COCO.index("couch") + 2
    assert vocabulary.index("tv-screen") == vocabulary.index("tv")
    assert vocabulary.index("armchair") != vocabulary.index("chair"), "a subclass keeps its name"


@pytest.mark.parametrize("name", ["", "  ", "_"])
def test_empty_name_is_other(name: str) -> None:
    assert Vocabulary().index(name) == OTHER


def test_new_names_above_the_cap_are_other() -> None:
    vocabulary = Vocabulary(cap=84)
    assert [vocabulary.index(name) for name in ("globe", "fan", "rug", "fan", "rug")] == [
        *(82, 83, OTHER, 83, OTHER)
    ]
    assert (len(vocabulary), vocabulary.refused) == (84, 2)
    assert vocabulary.find("rug") is None


def test_cap_below_the_first_names_raises() -> None:
    with pytest.raises(ConfigError, match="must be at least 82, the number"):
        Vocabulary(cap=81)


@given(st.lists(st.text(max_size=12), max_size=30), st.integers(82, 100))
def test_restored_vocabulary_continues_equal(names: list[str], cap: int) -> None:
    vocabulary = Vocabulary(cap)
    indices = [vocabulary.index(name) for name in names]
    assert all(0 <= index < cap for index in indices)
    restored = Vocabulary.unpack(json.loads(json.dumps(vocabulary.pack())))
    assert restored.pack() == vocabulary.pack()
    assert [restored.find(name) or OTHER for name in names] == indices
    assert restored.index("brand new") == vocabulary.index("brand new")


@pytest.mark.parametrize(
    "change",
    [
        {"names": ["background", "other"]},
        {"names": ["other", "background", *COCO]},
        {"names": ["background", "other", *COCO, "fan", "fan"]},
        {"names": ["background", "other", *COCO, "fan"], "cap": 82},
    ],
)
def test_invalid_saved_names_raise(change: dict) -> None:
    with pytest.raises(ValueError, match="name"):
        Vocabulary.unpack({**Vocabulary().pack(), **change})
