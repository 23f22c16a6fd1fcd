"""Target scores of loop closing on data sets.

The tests take minutes, the last one half an hour; run them with `pytest -m slow tests/runs`.
"""

import json
import os
from pathlib import Path

import pytest

from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.results import Results, evaluate_run
from ldo_service.runs.finished import read_run
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection

from .false_closures import Drift, DriftingTracker, replaced_actors

LEAVES, RETURNS = range(2, 10), range(154, 160)  # Frames of one place in the apartment.
# 1 % of the distance, to one side of the world; loops cannot correct an error of the scale.
DRIFT = Drift(scale=0.0, aside=0.01)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


def evaluated_run(
    sequence: Sequence, folder: Path, drift: Drift | None = None, frames: int | None = None
) -> Results:
    config = load_config(settings=("tracker.hold_out=5",))
    prepare(folder, overwrite=False)
    job = RunOptions(sequence, folder, config, Selection(max_frames=frames), print)
    with replaced_actors(
        *([DriftingTracker(actor_parameters(config).tracker, drift)] if drift else [])
    ):
        run_offline(job, lambda *_: None)
    threads = os.cpu_count() or 1
    return evaluate_run(read_run(folder), sequence, lambda _: None, threads=threads)


def ate_m(results: Results, estimate: str) -> float:
    assert results.trajectories is not None
    return results.trajectories[estimate].ate_m.rmse


def test_kitchen_gets_true_closures_only(data: Path, tmp_path: Path) -> None:
    results = evaluated_run(open_sequence(str(data / "tum/kitchen")), tmp_path / "run")
    assert results.loops is not None
    assert results.loops.true_closures == results.loops.closures >= 1
    assert ate_m(results, "final") < ate_m(results, "online") + 0.005
    assert ate_m(results, "final") < 0.035


def test_return_in_the_apartment_is_closed(data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    results = evaluated_run(
        open_sequence(str(data / "replica/apartment_floor1")), folder, frames=165
    )
    assert results.loops is not None
    assert results.loops.true_closures == results.loops.closures
    keyframes, loops = (
        json.loads((folder / name).read_text()) for name in ("keyframes.json", "loops.json")
    )
    frame = {k["keyframe"]: k["frame_index"] for k in keyframes}
    closed = [(frame[c["reference"]], frame[c["keyframe"]]) for c in loops["closures"]]
    assert any(old in LEAVES and new in RETURNS for old, new in closed)
    assert ate_m(results, "final") <= ate_m(results, "online")


def test_loop_closures_correct_drift_of_trajectory_and_map(tmp_path: Path) -> None:
    flat = open_sequence("synthetic:flat")
    without, drifting = (
        evaluated_run(flat, tmp_path / "w"),
        evaluated_run(flat, tmp_path / "d", DRIFT),
    )
    assert ate_m(drifting, "online") > 0.05
    assert ate_m(drifting, "final") < ate_m(drifting, "online") / 5
    held_out = [results.renderings[0] for results in (without, drifting)]
    assert {row.protocol for row in held_out} == {"A held out"}
    lost_db = held_out[0].mean("psnr_db") - held_out[1].mean("psnr_db")
    assert lost_db < 0.5
