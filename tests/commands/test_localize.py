"""The command `ldo run --localize DIR`: poses in the unchanged map of DIR."""

import csv
from pathlib import Path

import numpy as np
import pytest

from ldo_service.commands.run import format_localization
from ldo_service.datasets import open_sequence
from ldo_service.geometry import Trajectory, se3

from .test_cli import assert_one_paragraph, ldo


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_localized_poses_are_in_the_map_frame_of_the_first_run(
    capsys, tmp_path: Path, finished_run: Path, room_folder: Path
) -> None:
    before, out = contents(finished_run), tmp_path / "again"
    arguments = ("run", room_folder, "--out", out, "--localize", finished_run)
    code, _, err = ldo(capsys, *arguments)
    assert code == 0, err
    assert contents(finished_run) == before
    with (out / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["LOST"] + ["OK"] * 15
    truth = open_sequence(str(room_folder)).truth()
    assert truth is not None
    T_map_world = se3.inverse(truth.T_world_camera[0])  # The first run started there.
    T_map_camera = Trajectory.load(out / "trajectory.txt").T_world_camera
    expected = T_map_world @ truth.T_world_camera[1:16]
    np.testing.assert_allclose(T_map_camera[:, :3, 3], expected[:, :3, 3], atol=0.01)


@pytest.mark.parametrize(
    ("ok", "hint"), [(0, "that maps is a map of this place"), (1, "unchanged")]
)
def test_summary_without_localized_frames_questions_the_map(ok: int, hint: str) -> None:
    assert hint in format_localization({"OK": ok, "WEAK": 0, "LOST": 3}, Path("maps"))


def test_folder_without_a_run_is_bad_data(capsys, tmp_path: Path, room_folder: Path) -> None:
    for verb in (("run", room_folder, "--out", tmp_path / "out"), ("serve",)):
        code, _, err = ldo(capsys, *verb, "--localize", room_folder)
        assert code == 3
        assert_one_paragraph(err)
        assert "keyframe_database.msgpack" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--refine-iterations", "5"), ("--overwrite",)])
def test_map_for_localization_cannot_be_refined_or_replaced(
    capsys, tmp_path: Path, finished_run: Path, room_folder: Path, options
) -> None:
    before = contents(finished_run)
    out = finished_run if "--overwrite" in options else tmp_path / "out"
    arguments = ("run", room_folder, "--out", out, "--localize", finished_run, *options)
    code, _, err = ldo(capsys, *arguments)
    assert code == 2
    assert_one_paragraph(err)
    assert contents(finished_run) == before
