"""Offline runs over a sequence: written files, repeatability and bad frames."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Cached, Sequence
from ldo_service.detection.vocabulary import FIRST_NAMES
from ldo_service.errors import DataError, FrameError
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.evaluation.views import EvaluatedFrames, evaluate_rendering
from ldo_service.gaussians.model import new_labels
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.runs.finished import MapFolder, read_run
from ldo_service.runs.folder import RunWriter
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Warn
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantics_file import write_semantics
from tests.detection.networks import squares_network

from .jobs import job

FRAMES = 24


class WithBadFrames(Cached):
    """A sequence with unreadable frames."""

    def __init__(self, sequence: Sequence, bad: set[int]) -> None:
        super().__init__(sequence)
        self._bad = bad

    def read(self, index: int) -> RawFrame:
        if index in self._bad:
            raise FrameError(f"frame {index} is truncated. Copy it again.")
        return super().read(index)


def run(sequence: Sequence, folder: Path, *settings: str, warn: Warn = print) -> RunWriter:
    return run_offline(job(sequence, folder, *settings, frames=FRAMES, warn=warn), lambda *_: None)


@pytest.fixture(scope="module")
def finished(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "out"
    run(room, folder)
    return folder


def test_every_frame_has_a_row_and_trajectories_match_ground_truth(
    room: Sequence, finished: Path
) -> None:
    truth = room.truth()
    assert truth is not None
    for name in ("trajectory_online.txt", "trajectory.txt"):
        estimate = Trajectory.load(finished / name)
        assert len(estimate) == FRAMES
        assert evaluate_trajectory(estimate, truth).ate_m.rmse < 0.002
    with (finished / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))
    assert {row["status"] for row in rows} == {"OK"}


def test_keyframes_are_written_with_rigid_poses(finished: Path) -> None:
    keyframes = json.loads((finished / "keyframes.json").read_text())
    assert [k["keyframe"] for k in keyframes] == list(range(len(keyframes)))
    assert len(keyframes) > 3
    for keyframe in keyframes:
        R = np.array(keyframe["T_map_camera"])[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert Camera(**keyframe["camera"]).width == 320


def test_summary_has_the_keys_that_tools_read(finished: Path) -> None:
    summary = json.loads((finished / "summary.json").read_text())
    expected = {
        *("frames", "frames_rejected", "keyframes", "gaussians", "fps", "wall_s", "cpu_s"),
        *(
            "peak_rss_mb",
            "stage_ms",
            "drops",
            "loops_accepted",
            "loops_rejected",
            "labeller_requests",
        ),
        *("optimizations", "isa", "threads", "versions", "gaussians_labelled", "boxes"),
    }
    assert expected <= set(summary)
    assert summary["frames"] == FRAMES
    assert summary["gaussians"] > 1000
    assert summary["optimizations"] >= summary["keyframes"], "one per keyframe and per refinement"
    assert set(summary["stage_ms"]["tracker"]) == {"p50", "p95"}
    calibration = {"calibration_finished", "depth_bias_residual_ratio", "readout_ms"}
    assert calibration <= set(summary["calibration"])


def test_the_map_is_a_ply_with_every_gaussian(finished: Path) -> None:
    header, _, body = (finished / "map.ply").read_bytes().partition(b"end_header\n")
    count = json.loads((finished / "summary.json").read_text())["gaussians"]
    assert f"element vertex {count}".encode() in header
    table = np.frombuffer(body, "<f4").reshape(count, 17)
    assert np.isfinite(table).all()
    np.testing.assert_allclose(np.linalg.norm(table[:, 13:17], axis=1), 1, atol=1e-5)


def test_two_runs_write_the_same_bytes(room: Sequence, finished: Path, tmp_path: Path) -> None:
    run(room, tmp_path / "again", "mapper.threads=2")
    for name in ("trajectory_online.txt", "trajectory.txt", "keyframes.json", "map.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (finished / name).read_bytes(), name


def test_bad_frames_are_skipped_and_counted_and_the_first_are_named(
    room: Sequence, tmp_path: Path
) -> None:
    warnings: list[str] = []
    bad = {5, 6, 12, 13, 14, 15}
    record = run(
        WithBadFrames(room, bad),
        tmp_path / "out",
        "offline.max_rejected_ratio=0.5",
        warn=warnings.append,
    )
    assert record.summary["frames_rejected"] == len(bad)
    assert len(record.online()) == FRAMES - len(bad)
    assert [int(text.split()[1]) for text in warnings] == [5, 6, 12, 13, 14]
    assert "only counted" in warnings[-1]


def test_too_many_bad_frames_fail_and_keep_partial_results(room: Sequence, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"10 of {FRAMES} frames"):
        run(WithBadFrames(room, set(range(10, 20))), tmp_path / "out", warn=lambda _text: None)
    assert (tmp_path / "out" / "summary.json").exists()


def test_sequence_without_readable_frames_fails(room: Sequence, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="could not be used"):
        run(WithBadFrames(room, set(range(FRAMES))), tmp_path / "out", warn=lambda _text: None)


def test_held_out_frames_are_marked_and_not_mapped(room: Sequence, tmp_path: Path) -> None:
    run(room, tmp_path / "out", "tracker.hold_out=5")
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    held_out = [row for row in rows if row["held_out"] == "1"]
    assert [int(row["frame"]) for row in held_out] == list(range(4, FRAMES, 5))
    assert not any(row["keyframe"] for row in held_out)


def test_refined_map_is_written_separately_and_renders_better(
    room: Sequence, tmp_path: Path
) -> None:
    options, done = replace(job(room, tmp_path / "out", frames=10), refine=30), []
    record = run_offline(options, lambda count, _total=None: done.append(count))
    assert record.summary["refine_iterations"] == 30
    assert done[-1] == options.work
    run = read_run(tmp_path / "out")
    evaluated = EvaluatedFrames.of(run.frames)
    online, refined = evaluate_rendering(room, evaluated, run.maps, lambda _done: None)
    assert (online.map, refined.map) == ("online", "refined")
    assert refined.mean("psnr_db") > online.mean("psnr_db") + 1


def test_forty_real_frames_stay_within_three_centimeters(data: Path, tmp_path: Path) -> None:
    from ldo_service.datasets import open_sequence

    kitchen = open_sequence(str(data / "tum" / "kitchen"))
    record = run_offline(job(kitchen, tmp_path / "out", frames=40), lambda *_: None)
    truth = kitchen.truth()
    assert truth is not None
    assert record.statuses["OK"] == 40
    assert evaluate_trajectory(record.online(), truth).ate_m.rmse < 0.03


def test_run_with_detector_writes_a_label_per_gaussian(
    room: Sequence, finished: Path, tmp_path: Path
) -> None:
    model = squares_network("yolov5", width=320, height=256).write(tmp_path / "squares.onnx")
    settings = (f"detector.model={model}", "detector.min_score=0.02")
    record = run(room, tmp_path / "out", *settings)
    saved, gaussians = MapFolder(tmp_path / "out").semantics(), record.replica.map
    assert saved is not None
    assert (tmp_path / "out" / "map.ply").read_bytes() == (finished / "map.ply").read_bytes()
    assert saved.labels.tobytes() == gaussians.labels[record.in_map()].tobytes()
    labelled = np.count_nonzero(top_labels(saved.labels))
    assert record.summary["gaussians_labelled"] == labelled > 0
    assert record.summary["boxes"] > 0
    assert {"red", "green", "blue"} & set(saved.names)


def test_run_without_detector_writes_no_labels(finished: Path) -> None:
    assert MapFolder(finished).semantics() is None
    assert not (finished / "semantics.npz").exists()


def test_labels_of_another_map_are_refused(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_bytes((finished / "map.ply").read_bytes())
    write_semantics(tmp_path / "semantics.npz", new_labels(7), FIRST_NAMES)
    with pytest.raises(DataError, match="labels 7 Gaussians"):
        MapFolder(tmp_path).semantics()
