"""Repeated rounds of a robot; later ones add no keyframes to the map."""

import csv
from pathlib import Path

import pytest

from ldo_service.datasets import Sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Trajectory
from ldo_service.runs.offline import run_offline

from .jobs import Rearranged, job

OUTWARD = range(0, 60, 3)
BACK = range(57, 0, -3)
ROUND = len(OUTWARD) + len(BACK)


@pytest.fixture(scope="module")
def rounds(room: Sequence) -> Rearranged:
    return Rearranged(room, [*OUTWARD, *BACK] * 2)


@pytest.fixture(scope="module")
def finished(rounds: Rearranged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rounds") / "out"
    run_offline(job(rounds, folder, "tracker.keyframes.reuse_after=8"), lambda *_: None)
    return folder


@pytest.fixture(scope="module")
def rows(finished: Path) -> list[dict[str, str]]:
    with (finished / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def test_after_the_first_round_no_keyframe_is_made(rows) -> None:
    first, second = (
        sum(row["keyframe"] != "" for row in rows[n * ROUND : (n + 1) * ROUND]) for n in range(2)
    )
    assert first >= 8
    assert second == 0
    assert {row["status"] for row in rows} == {"OK"}
    assert sum(row["pose_source"] == "reused" for row in rows[ROUND:]) > 4


def test_online_and_final_poses_match_ground_truth(finished: Path, rounds: Rearranged) -> None:
    for name in ("trajectory.txt", "trajectory_online.txt"):
        track = Trajectory.load(finished / name)
        assert len(track) == len(rounds)
        assert evaluate_trajectory(track, rounds.truth()).ate_m.max < 5e-3
