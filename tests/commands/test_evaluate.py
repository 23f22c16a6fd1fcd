"""The command `ldo eval` on a run over 16 frames, 3 of them held out."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

from ldo_service.runs.folder import MAP_FILES, prepare
from ldo_service.tracking.keyframe_database import DATABASE_FILE
from tests.commands.test_cli import ldo


def last_line(text: str) -> str:
    return text.strip().splitlines()[-1]


@pytest.fixture
def without_truth(room_folder: Path, tmp_path: Path) -> Path:
    folder = shutil.copytree(room_folder, tmp_path / "without_truth")
    (folder / "groundtruth.txt").unlink()
    return folder


def test_protocol_is_printed_above_the_scores(capsys, run: Path, room_folder: Path) -> None:
    code, out, _ = ldo(capsys, "eval", run, room_folder, "--protocol")
    assert code == 0
    parts = (
        *(
            "Umeyama",
            "ATE RMSE",
            "A: held-out frames",
            "B: as in the literature",
            "A: 3 of 3 frames",
        ),
        *(
            "LPIPS is not computed",
            "PSNR dB",
            "A held out, exposure fitted",
            "B training",
            "Pictures",
        ),
    )
    places = [out.index(part) for part in parts]
    assert places == sorted(places)
    assert out.count("LPIPS") == 1
    _, short, _ = ldo(capsys, "eval", run, room_folder)
    assert "Umeyama" not in short
    assert "A: held-out frames" not in short
    assert "ATE RMSE" in short
    assert "ldo eval --protocol" in short
    sheet = cv2.imread(str(run / "rendering.png"))
    assert sheet is not None
    assert sheet.shape[0] > 3 * 240, "a row for each held-out frame"


def test_localization_run_without_a_map_has_its_trajectory_evaluated(
    capsys, run: Path, room_folder: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    code, out, _ = ldo(
        *(capsys, "run", room_folder, "--out", again, "--localize", run, "--max-frames", "6")
    )
    assert code == 0
    assert f"The run localized in the map of {run}" in " ".join(out.split())
    assert not {path.name for path in again.iterdir()} & {
        "map.ply",
        "keyframes.json",
        DATABASE_FILE,
    }
    code, out, _ = ldo(capsys, "eval", again, room_folder)
    assert code == 0
    assert "renderings are not evaluated" in out
    assert "PSNR" not in out
    for arguments in (
        ("export", again, "--format", "ply"),
        ("run", room_folder, "--out", tmp_path / "x", "--localize", again),
    ):
        code, _, err = ldo(capsys, *arguments)
        assert code == 3
        assert f"{again} has no" in err


def test_run_without_map_and_ground_truth_has_nothing_to_evaluate(
    capsys, run: Path, without_truth: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    ldo(capsys, "run", without_truth, "--out", again, "--localize", run, "--max-frames", "3")
    code, _, err = ldo(capsys, "eval", again, without_truth)
    assert code == 3
    assert "no map, so there is nothing to evaluate" in " ".join(err.split())


def test_json_has_all_scores_of_every_frame(capsys, run: Path, room_folder: Path) -> None:
    code, out, _ = ldo(capsys, "eval", run, room_folder, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["trajectory"]["final"]["ate_m"]["rmse"] < 0.005
    held_out, fitted, plain, training = found["rendering"]
    assert (held_out["protocol"], held_out["map"]) == ("A held out", "online")
    assert "exposure fitted" in fitted["protocol"]
    assert [view["frame"] for view in held_out["per_frame"]] == [4, 9, 14]
    assert [view["frame"] for view in training["per_frame"]] == [0, 6, 12]
    for row in (held_out, fitted, plain, training):
        of_frames = [view["psnr_db"] for view in row["per_frame"]]
        assert row["mean"]["psnr_db"] == pytest.approx(np.mean(of_frames))
        assert row["median"]["psnr_db"] == pytest.approx(np.median(of_frames))
    assert fitted["mean"]["psnr_db"] > held_out["mean"]["psnr_db"] > 25


def test_ate_equals_that_of_evo(capsys, run: Path, room_folder: Path) -> None:
    _, out, _ = ldo(capsys, "eval", run, room_folder, "--json")
    files = (room_folder / "groundtruth.txt", run / "trajectory.txt")
    loaded = (file_interface.read_tum_trajectory_file(file) for file in files)
    truth, estimate = sync.associate_trajectories(*loaded, max_diff=0.02)
    estimate.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    evo_statistics, ate = ape.get_all_statistics(), json.loads(out)["trajectory"]["final"]["ate_m"]
    assert ate == pytest.approx({name: evo_statistics[name] for name in ate}, abs=1e-6)


def test_map_is_evaluated_without_ground_truth(capsys, run: Path, without_truth: Path) -> None:
    code, out, _ = ldo(capsys, "eval", run, without_truth)
    assert code == 0
    assert "no ground truth" in out
    assert "ATE" not in out
    assert "A held out" in out
    code, out, _ = ldo(capsys, "eval", run, without_truth, "--json")
    assert json.loads(out)["trajectory"] is None


def test_run_with_nothing_to_evaluate_is_bad_data(capsys, run: Path, without_truth: Path) -> None:
    lines = (run / "frames.csv").read_text().replace(",OK,", ",LOST,")
    (run / "frames.csv").write_text(lines)
    code, _, err = ldo(capsys, "eval", run, without_truth)
    assert code == 3
    assert "nothing to evaluate" in last_line(err)


def test_refined_map_has_its_own_rows(capsys, run: Path, room_folder: Path) -> None:
    (run / "refined").mkdir()
    for name in MAP_FILES:
        shutil.copy(run / name, run / "refined")
    code, out, _ = ldo(capsys, "eval", run, room_folder, "--json")
    assert code == 0
    found = json.loads(out)
    online, refined = found["rendering"][:4], found["rendering"][4:]
    assert {row["map"] for row in online} == {"online"}
    assert {row["map"] for row in refined} == {"refined"}
    assert [row["mean"] for row in online] == [row["mean"] for row in refined]
    assert found["trajectory"]["refined"] == found["trajectory"]["final"]


def test_without_held_out_frames_the_option_for_them_is_named(
    capsys, run: Path, room_folder: Path
) -> None:
    header, *lines = (run / "frames.csv").read_text().splitlines()
    column = header.split(",").index("held_out")
    rows = [[*row[:column], "0", *row[column + 1 :]] for row in (line.split(",") for line in lines)]
    (run / "frames.csv").write_text("\n".join([header, *map(",".join, rows)]))
    code, out, _ = ldo(capsys, "eval", run, room_folder)
    assert code == 0
    assert "A: none" in out
    assert "--hold-out-every 5" in out
    assert "A held out" not in out
    assert "B training" in out


@pytest.mark.parametrize("name", ["map.ply", "config.yaml", "frames.csv", "trajectory.txt"])
def test_a_missing_file_is_one_clear_error(capsys, run: Path, room_folder: Path, name) -> None:
    (run / name).unlink()
    code, out, err = ldo(capsys, "eval", run, room_folder)
    assert (code, out) == (3, "")
    assert len(err.splitlines()) == 1
    assert name in err


def test_a_truncated_map_is_one_clear_error(capsys, run: Path, room_folder: Path) -> None:
    content = (run / "map.ply").read_bytes()
    for length in (0, 50, len(content) // 2, len(content) - 1):
        (run / "map.ply").write_bytes(content[:length])
        code, _, err = ldo(capsys, "eval", run, room_folder)
        assert code == 3
        assert len(err.splitlines()) == 1
        assert "map.ply" in err


def test_source_other_than_that_of_the_run_is_refused(capsys, run: Path) -> None:
    code, _, err = ldo(capsys, "eval", run, "synthetic:tour")
    assert code == 3
    assert "Give the SOURCE of the run" in last_line(err)


def test_invalid_lpips_network_is_refused_before_rendering(
    capsys, run: Path, room_folder: Path
) -> None:
    (run / "lpips.onnx").write_text("no network")
    code, _, err = ldo(capsys, "eval", run, room_folder, "--lpips", run / "lpips.onnx")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "cannot be opened" in err


def test_new_run_may_replace_images_of_eval(capsys, run: Path, room_folder: Path) -> None:
    ldo(capsys, "eval", run, room_folder)
    prepare(run, overwrite=True)
    assert list(run.iterdir()) == []
