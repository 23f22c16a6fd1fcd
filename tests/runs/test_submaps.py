"""Offline runs of a camera that is moved away, starts a submap, and returns to merge it."""

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

from .jobs import AWAY, BACK, EARLY_SUBMAPS, HERE, ROUGH, Rearranged, job, quick_submaps


@pytest.fixture(scope="module", autouse=True)
def _quick_submaps() -> Iterator[None]:
    with quick_submaps():
        yield


@pytest.fixture(scope="module")
def walk_with_return(room: Sequence) -> Rearranged:
    return Rearranged(room, [*HERE, *AWAY, *BACK])


@pytest.fixture(scope="module")
def finished(walk_with_return: Rearranged, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submaps") / "out"
    run_offline(job(walk_with_return, folder, *EARLY_SUBMAPS), lambda *_: None)
    return folder


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def test_lost_camera_starts_a_submap_that_is_merged_on_return(finished: Path) -> None:
    rows = rows_of(finished)
    assert [row["status"] for row in rows[12:14]] == ["LOST", "LOST"]
    assert {row["status"] for row in (*rows[:12], *rows[14:])} == {"OK"}
    submaps = [int(row["submap"]) for row in rows]
    merged_at = submaps.index(0, 14)
    assert merged_at > 14
    assert submaps == [0] * 14 + [1] * (merged_at - 14) + [0] * (len(rows) - merged_at)


def test_final_poses_share_one_frame_and_match_ground_truth(
    finished: Path, walk_with_return: Rearranged
) -> None:
    final = Trajectory.load(finished / "trajectory.txt")
    assert len(final) == len(walk_with_return) - 2
    assert evaluate_trajectory(final, walk_with_return.truth()).ate_m.max < 0.01


def test_online_trajectory_excludes_poses_of_the_unmerged_submap(finished: Path) -> None:
    online = Trajectory.load(finished / "trajectory_online.txt")
    unmerged = sum(row["submap"] == "1" for row in rows_of(finished))
    assert unmerged > 0
    assert len(online) == len(rows_of(finished)) - 2 - unmerged
    assert np.abs(online.T_world_camera[:, :3, 3]).max() < 5


def test_merged_map_has_a_single_submap(finished: Path) -> None:
    means = MapFolder(finished).gaussians()[:, :3]
    assert np.abs(means).max() < 10, "no Gaussians of an unmerged submap"
    keyframes = json.loads((finished / "keyframes.json").read_text())
    assert {keyframe["submap"] for keyframe in keyframes} == {0}


@pytest.mark.slow
def test_merged_map_is_refitted_at_the_end_of_the_run(
    finished: Path, walk_with_return: Rearranged, tmp_path: Path
) -> None:
    none_per_keyframe, none_pending = (
        "mapper.refit.iterations_per_keyframe=0",
        "mapper.refit.iterations=0",
    )
    refit_at_end, without_refit = tmp_path / "refit_at_end", tmp_path / "without_refit"
    run_offline(
        job(walk_with_return, refit_at_end, *EARLY_SUBMAPS, none_per_keyframe), lambda *_: None
    )
    run_offline(job(walk_with_return, without_refit, *EARLY_SUBMAPS, none_pending), lambda *_: None)
    with_keyframes, at_end, never_refitted = (
        json.loads((folder / "summary.json").read_text())
        for folder in (finished, refit_at_end, without_refit)
    )
    assert with_keyframes["iterations_pending"] == at_end["iterations_pending"] == 0
    assert at_end["iterations"] >= never_refitted["iterations"] + 12
    quality = [
        evaluate_rendering(
            walk_with_return, EvaluatedFrames.of(run.frames), run.maps, lambda _: None
        )[0]
        for run in (read_run(refit_at_end), read_run(without_refit))
    ]
    assert quality[0].mean("psnr_db") > quality[1].mean("psnr_db") + 0.5


def test_submap_without_return_stays_unmerged(room: Sequence, tmp_path: Path) -> None:
    one_way = Rearranged(room, [*HERE, *AWAY])
    run_offline(job(one_way, tmp_path / "out", *EARLY_SUBMAPS), lambda *_: None)
    final = Trajectory.load(tmp_path / "out/trajectory.txt")
    assert len(final) == len(HERE)
    keyframes = json.loads((tmp_path / "out/keyframes.json").read_text())
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    means = MapFolder(tmp_path / "out").gaussians()[:, :3]
    assert len(means) == summary["gaussians"] > 1000
    assert summary["gaussians_unmerged"] > 1000
    assert np.abs(means).max() < 10, "unmerged Gaussians are not in the map file"
    distances = {k["submap"]: np.abs(np.array(k["T_map_camera"])[:3, 3]).max() for k in keyframes}
    assert distances[0] < 5
    assert distances[1] > 50


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_two_simulations_of_a_return_give_equal_digests(walk_with_return: Rearranged) -> None:
    config = load_config(settings=(ROUGH, *EARLY_SUBMAPS))
    one, two = (
        simulate_graph(walk_with_return, config, Selection(), print, lambda _: None)
        for _ in range(2)
    )
    assert one == two
