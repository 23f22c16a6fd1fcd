"""Search for objects by text."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import answers_to, normalized
from ldo_service.errors import did_you_mean

# Text encoder of an open-vocabulary labeller. It maps T texts to unit vectors, [T, D]; a
# text without a vector gets zeros. It raises TextComparisonError if it fails.
Encode = Callable[[Sequence[str]], np.ndarray]

# Score of a hyponym or hypernym of the text; the text itself and its synonyms score 1.
SYNONYM_SCORE = 0.9
MIN_COSINE = 0.85  # Minimum cosine of text vectors; CLIP gives 0.7 to unrelated names.
# Minimum cosine of the vectors of a sentence encoder. Of 20 descriptions of objects in a room, 19
# have a right name above it with all-MiniLM-L6-v2.
MIN_SENTENCE_COSINE = 0.35
MIN_SCORE = 0.1  # Minimum score of a hit.


class TextComparisonError(Exception):
    """Failure to compare texts by meaning; the error message is a sentence with the reason."""


@dataclass(frozen=True, slots=True)
class SearchHit:
    """Object that matches a text."""

    index: int  # Index of the object in the sequence searched.
    score: float  # Score, 0..1.


def search(
    text: str,
    objects: Sequence[Mapping[str, float]],
    encode: Encode | None = None,
    min_cosine: float = MIN_COSINE,
) -> list[SearchHit]:
    """Return the objects that match `text`, best first; equal scores keep the order of `objects`.

    The score of an object is the maximum of p(name) * nearness(name) over its names. p(name) is the
    probability that the object has this name. Objects with a score below 0.1 are omitted.

    nearness(name) is 1 for `text` and its synonyms, and 0.9 for its hyponyms and hypernyms. Any
    other name is compared by `encode`: its nearness is the cosine between the vectors of the name
    and of `text`. A cosine below `min_cosine` counts as 0. Without `encode`, other names have nearness 0.

    Args:
        text: Name to search for.
        objects: For each object, the probability of each of its names, 0..1.
        encode: Text encoder; None: names are compared by the vocabulary only.
        min_cosine: Minimum cosine of similar texts, which depends on the text encoder.

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.

    >>> things = [{"chair": 0.8, "couch": 0.2}, {"couch": 1.0}, {"armchair": 0.5}]
    >>> [(hit.index, hit.score) for hit in search("Sofa", things)]
    [(1, 1.0), (0, 0.2)]
    >>> [(hit.index, hit.score) for hit in search("chair", things)]
    [(0, 0.8), (2, 0.45)]
    """
    near = text_similarity(text, sorted({name for p in objects for name in p}), encode, min_cosine)
    scores = [max((p[name] * near.get(name, 0) for name in p), default=0) for p in objects]
    hits = [SearchHit(i, score) for i, score in enumerate(scores) if score >= MIN_SCORE]
    return sorted(hits, key=lambda hit: -hit.score)


def text_similarity(
    text: str,
    names: Sequence[str],
    encode: Encode | None = None,
    min_cosine: float = MIN_COSINE,
) -> dict[str, float]:
    """Return the nearness, 0..1, of names to `text`, by name; `search` defines the nearness.

    Names with a nearness of 0 are omitted. The result also contains the synonyms, hyponyms and
    hypernyms of `text`, even if they are not in `names`.

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.
    """
    itself, *akin = answers_to(text)
    near = dict.fromkeys(akin, SYNONYM_SCORE) | {itself: 1.0}
    others = [name for name in names if name not in near]
    if encode is not None and others:
        vectors = encode([normalized(text), *others])
        if not vectors[0].any():
            raise TextComparisonError(
                f"The text encoder has no vector for {text!r}. Search for another word."
            )
        cosines = np.clip(vectors[1:] @ vectors[0], 0, 1)
        for name, cosine in zip(others, cosines.tolist(), strict=True):
            if cosine >= min_cosine:
                near[name] = cosine
    return near


def suggest_names(text: str, names: Sequence[str], max_names: int = 5) -> str:
    """Return a sentence that suggests the name spelled most like `text`.

    If no name is similar, the sentence lists the most common names.
    """
    distinct = sorted(set(names), key=lambda name: (-names.count(name), name))
    more = " and more" if len(distinct) > max_names else ""
    common = f"The names in the map are {', '.join(distinct[:max_names])}{more}."
    return did_you_mean(normalized(text), distinct, common)
