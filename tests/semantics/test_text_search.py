import doctest

import numpy as np
import pytest

from ldo_service.detection.vocabulary import COCO
from ldo_service.semantics import text_search as module
from ldo_service.semantics.text_search import MIN_COSINE, TextEncoder, search, suggest_names

OBJECTS = [{"couch": 0.9, "chair": 0.1}, {"chair": 0.7}, {"whiteboard": 1.0}, {"chair": 0.7}]


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("couch", [0]),
        ("SOFA", [0]),
        ("settee", [0]),
        ("chair", [1, 3, 0]),
        ("armchair", [1, 3]),  # Detectors have no narrower class; 0.9 of 0.1 is too little.
        ("whiteboard", [2]),
        ("toaster", []),
        ("", []),
    ],
)
def test_search_finds_names_and_synonyms(text: str, expected: list[int]) -> None:
    assert [hit.index for hit in search(text, OBJECTS)] == expected


def test_embeddings_find_words_without_synonym() -> None:
    axes = {"blackboard": [1, 0.0], "whiteboard": [0.95, 0.31225], "couch": [0, 1], "chair": [0, 1]}
    encoded: list[tuple[str, ...]] = []

    def encode(texts):
        encoded.append(tuple(texts))
        return np.array([axes[text] for text in texts], float)

    assert search("Blackboard", OBJECTS) == []
    (hit,) = search("Blackboard", OBJECTS, TextEncoder(encode, MIN_COSINE))
    assert (hit.index, round(hit.score, 3)) == (2, 0.95)
    assert encoded == [("blackboard", "chair", "couch", "whiteboard")]


def test_search_matches_brute_force_sorted_by_score() -> None:
    rng = np.random.default_rng(2)
    objects = [
        dict(
            zip(rng.choice(COCO, 4, replace=False).tolist(), rng.dirichlet(np.ones(4)), strict=True)
        )
        for _ in range(300)
    ]
    hits = search("television", objects)
    expected = {i: p["tv"] for i, p in enumerate(objects) if p.get("tv", 0) >= 0.1}
    assert {hit.index: hit.score for hit in hits} == expected
    assert [hit.score for hit in hits] == sorted(expected.values(), reverse=True)


def test_suggestion_is_similar_name_or_most_common_names() -> None:
    names = ["chair", "chair", "couch", "vase"]
    assert suggest_names("Chiar", names) == "Did you mean chair?"
    assert suggest_names("xylophone", names) == "The names in the map are chair, couch, vase."
    assert suggest_names("xylophone", names, 2) == "The names in the map are chair, couch and more."
