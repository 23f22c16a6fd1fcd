"""Search for objects by text."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import answers_to, normalized
from ldo_service.errors import did_you_mean

# Function from T texts to their unit vectors [T, D], the text encoder of an open-vocabulary
# labeller; zeros where it has no vector. Raises TextComparisonError.
Encode = Callable[[Sequence[str]], np.ndarray]

# Score of a hyponym or hypernym of the text; the text itself and its synonyms score 1.
SYNONYM_SCORE = 0.9
MIN_COSINE = 0.85  # Minimum cosine of text vectors; CLIP gives 0.7 to unrelated names.
MIN_SCORE = 0.1


class TextComparisonError(Exception):
    """Failed comparison of texts by meaning; the message is a sentence with the reason."""


@dataclass(frozen=True, slots=True)
class SearchHit:
    """Object that matches a text."""

    index: int  # Index of the object in the sequence searched.
    score: float  # Score, 0..1.


def search(
    text: str, objects: Sequence[Mapping[str, float]], encode: Encode | None = None
) -> list[SearchHit]:
    """Return the objects that match `text`, best first; equal scores keep the order of `objects`.

    The score of an object with the probabilities p by name is

        max over its names of  p(name) nearness(name)

    nearness is 1 for `text` and its synonyms, 0.9 for its hyponyms and hypernyms. For other names
    it is the cosine of the text vectors, from 0.85 on, if `encode` is given.

    Args:
        text: Name to search for.
        objects: Probabilities of each object by name.
        encode: Text encoder; None: names are compared by the vocabulary only.

    >>> things = [{"chair": 0.8, "couch": 0.2}, {"couch": 1.0}, {"armchair": 0.5}]
    >>> [(hit.index, hit.score) for hit in search("Sofa", things)]
    [(1, 1.0), (0, 0.2)]
    >>> [(hit.index, hit.score) for hit in search("chair", things)]
    [(0, 0.8), (2, 0.45)]
    """
    near = text_similarity(text, sorted({name for p in objects for name in p}), encode)
    scores = [max((p[name] * near.get(name, 0) for name in p), default=0) for p in objects]
    hits = [SearchHit(i, score) for i, score in enumerate(scores) if score >= MIN_SCORE]
    return sorted(hits, key=lambda hit: -hit.score)


def text_similarity(
    text: str, names: Sequence[str], encode: Encode | None = None
) -> dict[str, float]:
    """Return the nearness of each name to `text`, as `search` defines it.

    Names that are not near to it are omitted.
    """
    itself, *akin = answers_to(text)
    near = dict.fromkeys(akin, SYNONYM_SCORE) | {itself: 1.0}
    others = [name for name in names if name not in near]
    if encode is not None and others:
        vectors = encode([normalized(text), *others])
        if not vectors[0].any():
            raise TextComparisonError(f"The text encoder has no vector for {text!r}.")
        cosines = np.clip(vectors[1:] @ vectors[0], 0, 1)
        for name, cosine in zip(others, cosines.tolist(), strict=True):
            if cosine >= MIN_COSINE:
                near[name] = cosine
    return near


def suggest_names(text: str, names: Sequence[str], max_names: int = 5) -> str:
    """Return a sentence that suggests the name spelled most like `text`.

    If no name is similar, the sentence lists the most common names.
    """
    distinct = sorted(set(names), key=lambda name: (-names.count(name), name))
    more = " and more" if len(distinct) > max_names else ""
    common = f"There is {', '.join(distinct[:max_names])}{more}."
    return did_you_mean(normalized(text), distinct, common)
