"""Search for objects by text."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO, answers_to, normalized
from ldo_service.errors import did_you_mean

# Text encoder of an open-vocabulary labeller, or a sentence encoder. It maps T texts to unit
# vectors, [T, D]; a text without a vector gets zeros. It raises TextComparisonError if it fails.
Encode = Callable[[Sequence[str]], np.ndarray]

# Score of a hyponym or hypernym of the text; the text itself and its synonyms score 1.
SYNONYM_SCORE = 0.9
MIN_COSINE = 0.85  # Minimum cosine of text vectors; CLIP gives 0.7 to unrelated names.
# Minimum distance of a similar cosine from the mean over the names of COCO, in standard deviations,
# and as a fraction of the distance of the best name. `docs/benchmarks/text-search.md` compares
# values and other rules.
MIN_DEVIATIONS = 2.5
MIN_OF_BEST = 0.7
MIN_SCORE = 0.1  # Minimum score of a hit.


class TextComparisonError(Exception):
    """Failure to compare texts by meaning; the error message is a sentence with the reason."""


@dataclass(frozen=True, slots=True)
class TextEncoder:
    """Text encoder, and the cosine from which two of its texts have a similar meaning."""

    encode: Encode
    min_cosine: float | None = None  # `min_cosine_of` replaces None, for each text.


@dataclass(frozen=True, slots=True)
class SearchHit:
    """Object that matches a text."""

    index: int  # Index of the object in the sequence searched.
    score: float  # Score, 0..1.


def search(
    text: str, objects: Sequence[Mapping[str, float]], encoder: TextEncoder | None = None
) -> list[SearchHit]:
    """Return the objects that match `text`, best first; equal scores keep the order of `objects`.

    The score of an object is the maximum of p(name) * nearness(name) over its names. p(name) is the
    probability that the object has this name. Objects with a score below 0.1 are omitted.

    nearness(name) is 1 for `text` and its synonyms, and 0.9 for its hyponyms and hypernyms. Any
    other name is compared by `encoder`: its nearness is the cosine between the vectors of the name
    and of `text`. It is 0 if the cosine is below the minimum cosine of the encoder. Without
    `encoder`, other names have nearness 0.

    Args:
        text: Name to search for.
        objects: For each object, the probability of each of its names, 0..1.
        encoder: Text encoder; None: names are compared by the vocabulary only.

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.

    >>> things = [{"chair": 0.8, "couch": 0.2}, {"couch": 1.0}, {"armchair": 0.5}]
    >>> [(hit.index, hit.score) for hit in search("Sofa", things)]
    [(1, 1.0), (0, 0.2)]
    >>> [(hit.index, hit.score) for hit in search("chair", things)]
    [(0, 0.8), (2, 0.45)]
    """
    itself, *akin = answers_to(text)
    near = dict.fromkeys(akin, SYNONYM_SCORE) | {itself: 1.0}
    others = sorted({name for p in objects for name in p} - near.keys())
    if encoder is not None and others:
        # An improbable name of an object must not decide which names count as similar.
        main = {max(p, key=p.__getitem__) for p in objects if p}
        near |= _similar_names(text, others, main, encoder)
    scores = [max((p[name] * near.get(name, 0) for name in p), default=0) for p in objects]
    hits = [SearchHit(i, score) for i, score in enumerate(scores) if score >= MIN_SCORE]
    return sorted(hits, key=lambda hit: -hit.score)


def nearest_names(
    text: str, names: Sequence[str], encoder: TextEncoder, max_names: int = 3
) -> list[tuple[str, float]]:
    """Return the names nearest to `text` in meaning with their cosines, the nearest first.

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.
    """
    distinct = sorted(set(names))
    cosines = _cosines(text, distinct, encoder.encode).tolist()
    ranked = sorted(zip(distinct, cosines, strict=True), key=lambda pair: -pair[1])
    return ranked[:max_names]


def min_cosine_of(best: float, vocabulary: np.ndarray) -> float:
    """Return the cosine that names with a meaning similar to a text exceed.

    The cosines of unrelated texts depend on the encoder and on the text: their mean is 0.1 for some
    encoders, and 0.8 for others. The cosines of the names of COCO show what is usual.

    Args:
        best: Largest cosine of a name in the map.
        vocabulary: Cosines between the text and the names of COCO, [80].
    """
    usual, deviation = float(vocabulary.mean()), float(vocabulary.std())
    return usual + max(MIN_DEVIATIONS * deviation, MIN_OF_BEST * (best - usual))


def suggest_names(text: str, names: Sequence[str], max_names: int = 5) -> str:
    """Return a sentence that suggests the name spelled most like `text`.

    If no name is similar, the sentence lists the most common names.
    """
    distinct = sorted(set(names), key=lambda name: (-names.count(name), name))
    more = " and more" if len(distinct) > max_names else ""
    common = f"The names in the map are {', '.join(distinct[:max_names])}{more}."
    return did_you_mean(normalized(text), distinct, common)


def _similar_names(
    text: str, names: Sequence[str], main: set[str], encoder: TextEncoder
) -> dict[str, float]:
    """Return the cosines of the names whose meaning is similar to that of `text`, by name.

    Args:
        text: Name to search for.
        names: Names to compare.
        main: Names that are the most probable name of an object.
        encoder: Text encoder.

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.
    """
    if encoder.min_cosine is not None:
        cosines, least = _cosines(text, names, encoder.encode), encoder.min_cosine
    else:
        both = _cosines(text, [*names, *COCO], encoder.encode)
        cosines, vocabulary = both[: len(names)], both[len(names) :]
        best = max(
            (cosine for name, cosine in zip(names, cosines, strict=True) if name in main), default=0
        )
        least = min_cosine_of(best, vocabulary)
    pairs = zip(names, cosines.tolist(), strict=True)
    return {name: min(cosine, 1) for name, cosine in pairs if cosine > least}


def _cosines(text: str, names: Sequence[str], encode: Encode) -> np.ndarray:
    """Return the cosines between the vectors of `text` and of the names, [N].

    Raises:
        TextComparisonError: If the text encoder fails or has no vector for `text`.
    """
    vectors = encode([normalized(text), *names])
    if not vectors[0].any():
        raise TextComparisonError(
            f"The text encoder has no vector for {text!r}. Search for another word."
        )
    return vectors[1:] @ vectors[0]
