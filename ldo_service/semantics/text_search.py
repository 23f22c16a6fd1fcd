"""Which objects somebody means who names a thing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import answers_to, normalized
from ldo_service.errors import did_you_mean

# Vectors [T, D] of length 1 of T texts, as the text half of an open-vocabulary labeller gives them;
# zeros of those that it cannot place. Raises NotCompared.
Encode = Callable[[Sequence[str]], np.ndarray]

# of a word for a kind of the thing, or for what it is a kind of; the thing itself is 1
SYNONYM_SCORE = 0.9
MIN_COSINE = 0.85  # of vectors of texts; CLIP has 0.7 for things that have nothing in common
MIN_SCORE = 0.1


class TextComparisonError(Exception):
    """Texts could not be compared by what they mean; the text says why, as a sentence."""


@dataclass(frozen=True, slots=True)
class SearchHit:
    index: int  # of the object among those searched
    score: float  # 0..1


def search(
    text: str, objects: Sequence[Mapping[str, float]], encode: Encode | None = None
) -> list[SearchHit]:
    """Objects that answer to `text`, the best first, of equals the first.

    The score of an object with the probabilities p, by name, is

        max over its names of  p(name) nearness(name)

    nearness is 1 of what was asked for and of words that mean the same, 0.9 of its kinds and of
    what it is a kind of; of other names the cosine of their vectors, from 0.85 on, where `encode`
    is given.

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
    """How near each name is to what is asked for; those that are not are left out."""
    itself, *akin = answers_to(text)
    near = dict.fromkeys(akin, SYNONYM_SCORE) | {itself: 1.0}
    others = [name for name in names if name not in near]
    if encode is not None and others:
        vectors = encode([normalized(text), *others])
        if not vectors[0].any():
            raise TextComparisonError(f"The pair of encoders has no text {text!r}.")
        cosines = np.clip(vectors[1:] @ vectors[0], 0, 1)
        for name, cosine in zip(others, cosines.tolist(), strict=True):
            if cosine >= MIN_COSINE:
                near[name] = cosine
    return near


def suggest_names(text: str, names: Sequence[str], max_names: int = 5) -> str:
    """Return a sentence with the name that looks like `text`, or else with the most common ones."""
    distinct = sorted(set(names), key=lambda name: (-names.count(name), name))
    more = " and more" if len(distinct) > max_names else ""
    common = f"There is {', '.join(distinct[:max_names])}{more}."
    return did_you_mean(normalized(text), distinct, common)
