"""Which objects somebody means who names a thing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from ldo_service.detection.vocabulary import answers_to, normalised

# Vectors [T, D] of length 1 of T texts, as the text half of an open-vocabulary labeller gives them;
# zeros of those that it cannot place. Raises NotCompared.
Encode = Callable[[Sequence[str]], np.ndarray]

AKIN = 0.9  # of a word for a kind of the thing, or for what it is a kind of; the thing itself is 1
LEAST_COSINE = 0.85  # of vectors of texts; CLIP has 0.7 for things that have nothing in common
LEAST_SCORE = 0.1


class NotCompared(Exception):
    """Texts could not be compared by what they mean; the text says why, as a sentence."""


@dataclass(frozen=True, slots=True)
class Hit:
    index: int  # of the object among those searched
    score: float  # 0..1


def search(
    text: str, objects: Sequence[Mapping[str, float]], encode: Encode | None = None
) -> list[Hit]:
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
    near = nearness(text, sorted({name for p in objects for name in p}), encode)
    scores = [max((p[name] * near.get(name, 0) for name in p), default=0) for p in objects]
    hits = [Hit(i, score) for i, score in enumerate(scores) if score >= LEAST_SCORE]
    return sorted(hits, key=lambda hit: -hit.score)


def nearness(text: str, names: Sequence[str], encode: Encode | None = None) -> dict[str, float]:
    """How near each name is to what is asked for; those that are not are left out."""
    itself, *akin = answers_to(text)
    near = dict.fromkeys(akin, AKIN) | {itself: 1.0}
    others = [name for name in names if name not in near]
    if encode is not None and others:
        vectors = encode([normalised(text), *others])
        if not vectors[0].any():
            raise NotCompared(f"The pair of encoders has no text {text!r}.")
        cosines = np.clip(vectors[1:] @ vectors[0], 0, 1)
        for name, cosine in zip(others, cosines.tolist(), strict=True):
            if cosine >= LEAST_COSINE:
                near[name] = cosine
    return near


def nearest_names(text: str, names: Sequence[str], count: int = 5) -> list[str]:
    """Names that look like `text`; where none does, the commonest of those given."""
    alike = get_close_matches(normalised(text), set(names), count, cutoff=0.6)
    if alike:
        return alike
    return sorted(set(names), key=lambda name: (-names.count(name), name))[:count]
