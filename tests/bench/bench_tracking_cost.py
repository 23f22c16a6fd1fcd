"""CPU time of the tracker per frame, compared with that of another checkout.

    python -m tests.bench.bench_tracking_cost [SOURCE ...] [--other CHECKOUT] [--frames N]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. CHECKOUT has its environment in .venv, and the code of commit 18f9264
or later. All trackers run with their defaults on one thread, without other actors, and track each
frame one directly after the other. The last row of each source is this checkout without
self-calibration. Times exclude the decoding of images and the first five frames.
"""

import argparse
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.datasets import open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Trajectory

from .bench_map_view import default_sources
from .bench_tracking import WARM_UP
from .checkouts import turn, workers

HEADER = """\
| source, frames | checkout | CPU ms per frame, mean | p50 | p95 | ratio | OK frames | ATE cm |
|---|---|---|---|---|---|---|---|"""


WITHOUT = "without self-calibration"


@dataclass(frozen=True, slots=True)
class Variant:
    """Tracker of one checkout."""

    name: str
    checkout: Path | None
    options: tuple[str, ...] = ()


def variants(other: Path | None) -> list[Variant]:
    """Return the trackers to compare; the ratios are relative to the first one."""
    ours = [Variant("this one", None), Variant(f"this one, {WITHOUT}", None, (WITHOUT,))]
    return ours if other is None else [Variant(other.name, other), *ours]


def measure(source: str, frames: int, compared: list[Variant]) -> list[list[dict[str, Any]]]:
    """Return the answers of each tracker, frame by frame."""
    count = min(frames, len(open_sequence(source)))
    places = [(each.checkout, ("track", source, *each.options)) for each in compared]
    with workers(places) as started:
        turns = [turn(started, index, str(index)) for index in range(count)]
    return [list(answers) for answers in zip(*turns, strict=True)]


def mean_ms(answers: list[dict[str, Any]]) -> float:
    return 1e3 * float(np.mean([answer["cpu_s"] for answer in answers[WARM_UP:]]))


def row(source: str, name: str, answers: list[dict[str, Any]], reference_ms: float) -> str:
    """Return a row of the table; the ratio is relative to `reference_ms`."""
    sequence = open_sequence(source)
    p50, p95 = 1e3 * np.percentile([answer["cpu_s"] for answer in answers[WARM_UP:]], [50, 95])
    statuses = Counter(answer["status"] for answer in answers)
    truth, stamps_s = sequence.truth(), sequence.stamps_ns[: len(answers)] * 1e-9
    estimate = Trajectory(stamps_s, np.array([answer["T"] for answer in answers]))
    ate = f"{100 * evaluate_trajectory(estimate, truth).ate_m.rmse:.2f}" if truth else ""
    cpu_ms = mean_ms(answers)
    return (
        f"| {sequence.name}, {len(answers)} | {name} | {cpu_ms:.1f} | {p50:.1f} | {p95:.1f} | "
        f"{cpu_ms / reference_ms:.2f} | {statuses['OK']} | {ate} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--other", type=Path, metavar="CHECKOUT")
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()
    compared = variants(arguments.other)
    print(HEADER)
    for source in arguments.sources or default_sources():
        measured = measure(source, arguments.frames, compared)
        reference_ms = mean_ms(measured[0])
        for variant, answers in zip(compared, measured, strict=True):
            print(row(source, variant.name, answers, reference_ms), flush=True)


if __name__ == "__main__":
    main()
