"""Precision and recall of text queries that a sentence encoder answers.

    python -m tests.bench.bench_text_search model.onnx tokenizer.json

Without files, the program measures all-MiniLM-L6-v2 of the dependency group `sentences`. The
queries are in text_queries.yaml. A query whose text is a name or synonym in the map is left out,
because the encoder is not asked then.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

from ldo_service.detection.sentence_encoder import SentenceEncoder
from ldo_service.detection.vocabulary import COCO
from ldo_service.semantics.text_search import Encode, TextEncoder, min_cosine_of, search
from tests.detection.minilm import package_folder, write_minilm

HEAD = """
| rule | precision | precision with absent | recall | answered | absent refused |
|---|---|---|---|---|---|"""
QUERIES = Path(__file__).with_name("text_queries.yaml")


@dataclass(frozen=True)
class Query:
    """Text with its cosines to the names of a map and of COCO, and with the right names."""

    text: str
    names: list[str]
    is_right: np.ndarray  # [N] bool; all False if the object is absent.
    cosines: np.ndarray  # [N]
    vocabulary: np.ndarray  # Cosines to the names of COCO, [80].


# Minimum cosine of the names that count as similar, for each rule of the table.
RULES: dict[str, Callable[[Query], float]] = {
    "cosine at least 0.35": lambda _: 0.35,
    "cosine at least 0.45": lambda _: 0.45,
    "at most 0.05 below the best": lambda query: query.cosines.max() - 0.05,
    "at least 0.8 of the best": lambda query: 0.8 * query.cosines.max(),
    "2.5 deviations above the mean of the map": lambda query: (
        query.cosines.mean() + 2.5 * query.cosines.std()
    ),
    "the best name only": lambda query: query.cosines.max(),
    "the three best names": lambda query: np.sort(query.cosines)[-3],
    "the software's rule": lambda query: min_cosine_of(query.cosines.max(), query.vocabulary),
}


def queries(part: str, encode: Encode) -> Iterator[Query]:
    """Yield the queries of one part of the file that the vocabulary does not answer."""
    reference = encode(list(COCO))
    for room in yaml.safe_load(QUERIES.read_text("utf-8"))[part].values():
        names = room["names"]
        vectors = encode(names)
        for text, right in [*room["answers"].items(), *((text, []) for text in room["absent"])]:
            if search(text, [{name: 1.0} for name in names]):
                continue
            (vector,) = encode([text])
            is_right = np.isin(names, right)
            yield Query(text, names, is_right, vectors @ vector, reference @ vector)


def scores(found: list[Query], rule: Callable[[Query], float]) -> str:
    """Return the cells of a rule, as in the head of the table."""
    present, absent = [], []
    for query in found:
        hits = query.cosines >= rule(query)
        (present if query.is_right.any() else absent).append((hits, query.is_right))
    right = sum(int((hits & is_right).sum()) for hits, is_right in present)
    wanted = sum(int(is_right.sum()) for _, is_right in present)
    printed, false = (sum(int(hits.sum()) for hits, _ in part) for part in (present, absent))
    answered = sum(bool((hits & is_right).any()) for hits, is_right in present)
    refused = sum(not hits.any() for hits, _ in absent)
    return (
        f"{right / max(printed, 1):.2f} | {right / max(printed + false, 1):.2f} | "
        f"{right / wanted:.2f} | {answered} of {len(present)} | {refused} of {len(absent)}"
    )


def check(found: list[Query], encode: Encode) -> None:
    """Check that `search` applies the last rule of the table."""
    for query in found:
        objects = [{name: 1.0} for name in query.names]
        hits = {hit.index for hit in search(query.text, objects, TextEncoder(encode))}
        least = RULES["the software's rule"](query)
        assert hits == set(np.flatnonzero(query.cosines > least).tolist()), query.text


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("network", type=Path, nargs="?")
    parser.add_argument("tokenizer", type=Path, nargs="?")
    parser.add_argument("--part", choices=["choose", "judge"], action="append")
    parser.add_argument("--list", action="store_true", help="print the three best names")
    args = parser.parse_args()
    with TemporaryDirectory() as folder:
        if args.network and args.tokenizer:
            encoder = SentenceEncoder(args.network, args.tokenizer)
        else:
            weights = package_folder()
            network = write_minilm(weights / "model.safetensors", Path(folder) / "model.onnx")
            encoder = SentenceEncoder(network, weights / "tokenizer.json")
        for part in args.part or ["choose", "judge"]:
            report(part, encoder.encode, args.list)


def report(part: str, encode: Encode, is_list: bool) -> None:
    found = list(queries(part, encode))
    check(found, encode)
    ranks = [
        int(np.flatnonzero(query.is_right[np.argsort(-query.cosines)])[0])
        for query in found
        if query.is_right.any()
    ]
    first, third = sum(rank < 1 for rank in ranks), sum(rank < 3 for rank in ranks)
    print(f"\n{part}: {len(found)} queries; right name first {first}, in the first three {third}")
    print(HEAD)
    for name, rule in RULES.items():
        print(f"| {name} | {scores(found, rule)} |")
    for query in found if is_list else []:
        least = RULES["the software's rule"](query)
        best = [
            f"{query.names[i]} {query.cosines[i]:.2f}{'' if query.cosines[i] > least else ' (cut)'}"
            for i in np.argsort(-query.cosines)[:3]
        ]
        print(f"{query.text}: {', '.join(best)}")


if __name__ == "__main__":
    main()
