"""A camera that is carried off, begins anew, and comes back: one map in the end."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.evaluation.views import EvaluatedFrames, evaluate_rendering
from ldo_service.geometry import Trajectory
from ldo_service.runs.finished import MapFolder, read_run
from ldo_service.runs.offline import run_offline
from ldo_service.runs.simulation import simulate_graph
from ldo_service.runs.source import Selection

from .jobs import AWAY, BACK, HERE, ROUGH, SOON, Rearranged, job, quick_submaps


@pytest.fixture(scope="module", autouse=True)
def _submaps_are_joined_soon() -> Iterator[None]:
    with quick_submaps():
        yield


@pytest.fixture(scope="module")
def returning(room: Sequence) -> Rearranged:
    return Rearranged(room, [*HERE, *AWAY, *BACK])


@pytest.fixture(scope="module")
def finished(returning: Rearranged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submaps") / "out"
    run_offline(job(returning, folder, *SOON), lambda *_: None)
    return folder


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def test_lost_then_apart_then_joined(finished: Path) -> None:
    rows = rows_of(finished)
    assert [row["status"] for row in rows[12:14]] == ["LOST", "LOST"]
    assert {row["status"] for row in (*rows[:12], *rows[14:])} == {"OK"}
    submaps = [int(row["submap"]) for row in rows]
    joined = submaps.index(0, 14)
    assert joined > 14
    assert submaps == [0] * 14 + [1] * (joined - 14) + [0] * (len(rows) - joined)


def test_in_the_end_every_pose_is_in_one_frame_and_right(
    finished: Path, returning: Rearranged
) -> None:
    final = Trajectory.load(finished / "trajectory.txt")
    assert len(final) == len(returning) - 2
    assert evaluate_trajectory(final, returning.truth()).ate_m.max < 0.01


def test_poses_that_were_apart_are_not_among_those_published_in_the_map(finished: Path) -> None:
    online = Trajectory.load(finished / "trajectory_online.txt")
    apart = sum(row["submap"] == "1" for row in rows_of(finished))
    assert apart > 0
    assert len(online) == len(rows_of(finished)) - 2 - apart
    assert np.abs(online.T_world_camera[:, :3, 3]).max() < 5


def test_the_map_is_whole(finished: Path) -> None:
    means = MapFolder(finished).gaussians()[:, :3]
    assert np.abs(means).max() < 10, "nothing was left apart"
    keyframes = json.loads((finished / "keyframes.json").read_text())
    assert {keyframe["submap"] for keyframe in keyframes} == {0}


def test_what_was_joined_is_fitted_again_at_the_end(
    finished: Path, returning: Rearranged, tmp_path: Path
) -> None:
    paid, due = "mapper.refit.iterations_per_keyframe=0", "mapper.refit.iterations=0"
    left, never = tmp_path / "left", tmp_path / "never"
    run_offline(job(returning, left, *SOON, paid), lambda *_: None)
    run_offline(job(returning, never, *SOON, due), lambda *_: None)
    with_keyframes, at_end, without = (
        json.loads((folder / "summary.json").read_text()) for folder in (finished, left, never)
    )
    assert with_keyframes["iterations_pending"] == at_end["iterations_pending"] == 0
    assert at_end["iterations"] >= without["iterations"] + 12
    quality = [
        evaluate_rendering(returning, EvaluatedFrames.of(run.frames), run.maps, lambda _: None)[0]
        for run in (read_run(left), read_run(never))
    ]
    assert quality[0].mean("psnr_db") > quality[1].mean("psnr_db") + 0.5


def test_a_submap_that_never_came_back_stays_apart(room: Sequence, tmp_path: Path) -> None:
    gone = Rearranged(room, [*HERE, *AWAY])
    run_offline(job(gone, tmp_path / "out", *SOON), lambda *_: None)
    final = Trajectory.load(tmp_path / "out/trajectory.txt")
    assert len(final) == len(HERE)
    keyframes = json.loads((tmp_path / "out/keyframes.json").read_text())
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    means = MapFolder(tmp_path / "out").gaussians()[:, :3]
    assert len(means) == summary["gaussians"] > 1000
    assert summary["gaussians_unmerged"] > 1000
    assert np.abs(means).max() < 10, "what is apart is not in the map's file"
    distances = {k["submap"]: np.abs(np.array(k["T_map_camera"])[:3, 3]).max() for k in keyframes}
    assert distances[0] < 5
    assert distances[1] > 50


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_what_every_actor_makes_of_a_return_is_the_same_each_time(returning: Rearranged) -> None:
    config = load_config(settings=(ROUGH, *SOON))
    one, two = (
        simulate_graph(returning, config, Selection(), print, lambda _: None) for _ in range(2)
    )
    assert one == two
