"""Summary of a soak of the live service.

    .venv/bin/python -m tests.faults.soak_summary soak.jsonl

The growth of memory, descriptors and threads is fitted to steady samples. A sample is steady if the
map has almost all of its keyframes and the last fault is at least 90 s ago. The summary also
compares the medians of the first and the last quarter of the time after the map is complete, and of
each part of this time between two starts of the service. Each start empties the mapper's cache of
keyframe images, which has a limit of its own. The summary therefore also shows memory without it.
"""

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

COMMANDS = ("save", "pause", "refine")
MEASURED = ("rss_mb", "descriptors", "threads")
NO_CACHE = "rss_without_cache_mb"  # Resident memory without the mapper's keyframe images.
SETTLED_S = 90.0  # Time after a fault whose samples do not count as steady.
FULL_RATIO = 0.98  # The map counts as complete with this fraction of its final keyframes.


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the JSON objects of a file."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def growth_per_hour(samples: list[dict[str, Any]], name: str) -> float:
    """Return the growth per hour by least squares; each set of processes has its own offset."""
    slopes = spread = 0.0
    for pids in {tuple(sample["processes"]) for sample in samples}:
        same = [sample for sample in samples if tuple(sample["processes"]) == pids]
        hours = np.array([sample["time_s"] / 3600 for sample in same])
        values = np.array([sample[name] for sample in same])
        slopes += float(np.sum((hours - hours.mean()) * (values - values.mean())))
        spread += float(np.sum((hours - hours.mean()) ** 2))
    return slopes / spread if spread else float("nan")


def quarters(samples: list[dict[str, Any]], name: str) -> str:
    """Return the medians of the first and the last quarter of the samples, and their difference."""
    count = max(len(samples) // 4, 1)
    first, last = samples[:count], samples[-count:]
    before, after = (float(np.median([s[name] for s in part])) for part in (first, last))
    hours = (
        float(np.mean([s["time_s"] for s in last]) - np.mean([s["time_s"] for s in first])) / 3600
    )
    per_hour = 100 * (after / before - 1) / hours if hours else float("nan")
    return f"{name} {before:.1f} to {after:.1f}, {per_hour:+.1f} % per hour"


def after_map(samples: list[dict[str, Any]], complete_s: float) -> list[str]:
    """Return a line for the time after the map is complete, and one for each start in it."""
    complete = [sample for sample in samples if sample["time_s"] >= complete_s]
    mains = dict.fromkeys(sample.get("main") for sample in complete)
    measured = list(MEASURED)
    if all("keyframes_cache_mb" in sample["mapper"] for sample in complete):
        measured.append(NO_CACHE)
        for sample in complete:
            sample[NO_CACHE] = sample["rss_mb"] - sample["mapper"]["keyframes_cache_mb"]
    parts = [complete, *([s for s in complete if s.get("main") == main] for main in mains)]
    return [
        f"medians of first and last quarter, minutes {part[0]['time_s'] / 60:.1f} to "
        f"{part[-1]['time_s'] / 60:.1f}: {'; '.join(quarters(part, name) for name in measured)}"
        for part in parts
    ]


def summary(lines: list[dict[str, Any]]) -> str:
    """Return the results of a run as text."""
    by_kind = {
        kind: [line for line in lines if line["kind"] == kind]
        for kind in ("sample", "command", "fault", "recovered", "violation")
    }
    samples, last = by_kind["sample"], by_kind["sample"][-1]
    poses, duration_s = sum(last["poses"].values()), last["time_s"]
    text = [
        f"{duration_s / 60:.1f} minutes, {last['sent']} frames, {poses} poses, "
        f"{poses / duration_s:.2f} per second, {last['poses'].get('OK', 0) / poses:.2%} OK: "
        f"{last['poses']}; at most {last['gap_s']:.1f} s between two poses, "
        f"{last['ok_gap_s']:.1f} s between two with status OK",
        *(
            f"{one['name']}: first OK pose after {one['first_ok_s']} s"
            for one in by_kind["recovered"]
        ),
    ]
    for name in COMMANDS:
        took_s = sorted(one["took_s"] for one in by_kind["command"] if one["name"] == name)
        if took_s:
            text.append(
                f"{name}: {len(took_s)}, median {took_s[len(took_s) // 2]}, max {took_s[-1]} s"
            )
    pids = {pid for sample in samples for pid in sample["processes"]}
    text.append(f"{len(pids)} different processes of the service")
    names = ("restarts", "failures", "dead_lettered", "quarantined", "rejected", "mapper")
    text.append(", ".join(f"{name} {last[name]}" for name in names))
    full = FULL_RATIO * max(sample["mapper"].get("keyframes", 0) for sample in samples)
    complete_s = next(s["time_s"] for s in samples if s["mapper"].get("keyframes", 0) >= full)
    faults_s = [fault["time_s"] for fault in by_kind["fault"]]
    steady = [
        sample
        for sample in samples
        if sample["time_s"] >= complete_s
        and not any(0 <= sample["time_s"] - fault_s <= SETTLED_S for fault_s in faults_s)
    ]
    text.append(f"the map is complete after {complete_s:.0f} s; {len(steady)} steady samples")
    text += after_map(samples, complete_s)
    ends_s = [i * duration_s / 4 for i in range(1, 5)]
    for name in MEASURED:
        means = [
            np.mean([s[name] for s in samples if start_s <= s["time_s"] <= end_s])
            for start_s, end_s in pairwise(ends_s)
        ]
        growth = growth_per_hour(steady, name)
        shown = ", ".join(f"{mean:.1f}" for mean in means)
        text.append(f"{name}: means of quarters 2 to 4: {shown}; growth {growth:+.2f} per hour")
    return "\n".join([*text, *(line["what"] for line in by_kind["violation"])])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="file of the soak")
    print(summary(read_lines(parser.parse_args().out)))


if __name__ == "__main__":
    main()
