"""Offline runs with a slow or failing labeller, which must not change poses and map."""

from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.runs.finished import MapFolder
from ldo_service.runs.folder import RunWriter
from ldo_service.runs.offline import run_offline
from ldo_service.runs.records import read_objects
from ldo_service.semantics.gaussian_labels import fields
from tests.detection.labellers.server import Server, hangs, replies_with, responds, serving

from .jobs import job

FRAMES = 16
QUICK = ("timeout_s=0.2", "max_attempts=1", "max_requests_per_minute=1000000000.0")


def run(sequence: Sequence, folder: Path, server: Server | None, latency: int) -> RunWriter:
    """Run with a labeller on `server`, whose results take `latency` frames; None is no labeller."""
    settings = [f"offline.latency_frames.vlm_labeller={latency}", "mapper.threads=1"]
    if server:
        settings += [f"vlm_labeller.http.{setting}" for setting in QUICK]
        settings += [f"vlm_labeller.url={server.url}"]
    return run_offline(job(sequence, folder, *settings, frames=FRAMES), lambda *_: None)


@pytest.fixture(scope="module")
def without_labeller(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("without_labeller") / "run"
    run(room, folder, None, 0)
    return folder


def assigned_labels(folder: Path) -> set[str]:
    """Return the labels that Gaussians of the map have."""
    semantics = MapFolder(folder).semantics()
    assert semantics is not None
    rows = fields(semantics.labels)
    return {semantics.names[k] for k in np.unique(rows["ids"][rows["weights"] > 0])}


@pytest.mark.parametrize("latency", [0, 10])
def test_late_label_results_leave_poses_and_map_bitwise_equal(
    room: Sequence, tmp_path: Path, without_labeller: Path, latency: int
) -> None:
    with serving(replies_with("samovar", 0.9)) as server:
        record = run(room, tmp_path / "run", server, latency)
        assert record.summary["labeller_requests"] > 0
    for name in ("trajectory_online.txt", "trajectory.txt", "map.ply", "keyframes.json"):
        assert (tmp_path / "run" / name).read_bytes() == (without_labeller / name).read_bytes(), (
            name
        )
    assert assigned_labels(tmp_path / "run") == {"samovar"}
    objects = read_objects(tmp_path / "run").objects
    assert {one.name for one in objects} <= {"samovar"}
    assert record.summary["objects"] == len(objects)
    assert not (without_labeller / "objects.json").exists()


@pytest.mark.parametrize(
    "behaves",
    [responds(500), replies_with("I think it is a kind of thing", 0.9), hangs],
    ids=["500", "nonsense", "hangs"],
)
def test_failing_server_leaves_the_run_unchanged_and_labels_nothing(
    room: Sequence, tmp_path: Path, without_labeller: Path, behaves
) -> None:
    with serving(behaves) as server:
        run(room, tmp_path / "run", server, 5)
        assert server.requests
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "run" / name).read_bytes() == (without_labeller / name).read_bytes(), (
            name
        )
    assert assigned_labels(tmp_path / "run") == set()
    assert read_objects(tmp_path / "run").objects == ()
