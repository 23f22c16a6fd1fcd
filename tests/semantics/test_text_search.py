import doctest

import numpy as np
import pytest

from ldo_service.detection.vocabulary import COCO
from ldo_service.semantics import text_search as module
from ldo_service.semantics.text_search import (
    MIN_COSINE,
    TextEncoder,
    nearest_names,
    search,
    suggest_names,
)

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


# --- sentence encoders ----------------------------------------------------------------------------
# Cosines between "place for a nap" and names; other names have 0.05 to 0.15, with the mean 0.1.
NAP = {"bed": 0.6, "couch": 0.5, "hammock": 0.42, "lamp": 0.2}


def nap_encoder(offset: float, scale: float) -> TextEncoder:
    """Return an encoder whose cosines are `offset` plus `scale` times those of `NAP`."""
    usual = {name: 0.05 + 0.1 * (index % 2) for index, name in enumerate(COCO)}

    def vector(text: str) -> tuple[float, float]:
        if text == "place for a nap":
            return 1, 0
        cosine = offset + scale * (NAP | {"door": 0.1} | usual | NAP)[text]
        return cosine, float(np.sqrt(1 - cosine**2))

    return TextEncoder(lambda texts: np.array([vector(text) for text in texts]))


@pytest.mark.parametrize(("offset", "scale"), [(0, 1), (0.75, 0.2)])
def test_similar_names_stand_out_from_those_of_coco(offset: float, scale: float) -> None:
    """The cut is 0.7 of the way from the mean 0.1 to the best name, so it is near 0.46."""
    objects = [{name: 1.0} for name in ("door", "lamp", "hammock", "couch", "bed")]
    hits = search("Place for a nap", objects, nap_encoder(offset, scale))
    assert [hit.index for hit in hits] == [4, 3]
    assert [hit.score for hit in hits] == pytest.approx(
        [offset + scale * 0.6, offset + scale * 0.5]
    )


def test_no_name_is_similar_if_none_stands_out() -> None:
    encoder = nap_encoder(0, 1)
    assert search("place for a nap", [{"lamp": 1.0}, {"door": 1.0}], encoder) == []
    nearest = nearest_names("place for a nap", ["door", "lamp", "lamp"], encoder)
    assert [name for name, _ in nearest] == ["lamp", "door"]
    assert nearest[0][1] == pytest.approx(0.2)


def test_improbable_name_does_not_hide_the_names_of_other_objects() -> None:
    objects = [{"lamp": 0.95, "bed": 0.05}, {"hammock": 1.0}]
    assert [hit.index for hit in search("place for a nap", objects, nap_encoder(0, 1))] == [1]
