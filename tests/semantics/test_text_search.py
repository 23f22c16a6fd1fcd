import doctest

import numpy as np
import pytest

from ldo_service.detection.vocabulary import COCO
from ldo_service.semantics import text_search as module
from ldo_service.semantics.text_search import search, suggest_names

THINGS = [{"couch": 0.9, "chair": 0.1}, {"chair": 0.7}, {"whiteboard": 1.0}, {"chair": 0.7}]


def test_the_examples_hold() -> None:
    assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("couch", [0]),
        ("SOFA", [0]),
        ("settee", [0]),
        ("chair", [1, 3, 0]),
        ("armchair", [1, 3]),  # detectors know no finer word; 0.9 of 0.1 is too little
        ("whiteboard", [2]),
        ("toaster", []),
        ("", []),
    ],
)
def test_names_and_other_words_for_them(text: str, expected: list[int]) -> None:
    assert [hit.index for hit in search(text, THINGS)] == expected


def test_embeddings_find_what_no_table_knows() -> None:
    axes = {"blackboard": [1, 0.0], "whiteboard": [0.95, 0.31225], "couch": [0, 1], "chair": [0, 1]}
    asked: list[tuple[str, ...]] = []

    def encode(texts):
        asked.append(tuple(texts))
        return np.array([axes[text] for text in texts], float)

    assert search("Blackboard", THINGS) == []
    (hit,) = search("Blackboard", THINGS, encode)
    assert (hit.index, round(hit.score, 3)) == (2, 0.95)
    assert asked == [("blackboard", "chair", "couch", "whiteboard")]


def test_scores_ascend_to_what_brute_force_finds_over_many_objects() -> None:
    rng = np.random.default_rng(2)
    many = [
        dict(
            zip(rng.choice(COCO, 4, replace=False).tolist(), rng.dirichlet(np.ones(4)), strict=True)
        )
        for _ in range(300)
    ]
    hits = search("television", many)
    expected = {i: p["tv"] for i, p in enumerate(many) if p.get("tv", 0) >= 0.1}
    assert {hit.index: hit.score for hit in hits} == expected
    assert [hit.score for hit in hits] == sorted(expected.values(), reverse=True)


def test_a_name_that_looks_alike_is_suggested_and_else_the_most_common_ones() -> None:
    names = ["chair", "chair", "couch", "vase"]
    assert suggest_names("Chiar", names) == "Did you mean chair?"
    assert suggest_names("xylophone", names) == "There is chair, couch, vase."
    assert suggest_names("xylophone", names, 2) == "There is chair, couch and more."
