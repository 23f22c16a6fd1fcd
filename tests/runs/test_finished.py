"""Folders of finished runs: complete, refined and damaged ones."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import DataError
from ldo_service.gaussians.file_formats import write_ply
from ldo_service.geometry import Camera, Trajectory, se3
from ldo_service.runs.finished import MapFolder, newest_map, read_run
from ldo_service.runs.folder import CAMERA, MAP_FILES, prepare

SOME_CAMERA = Camera(320, 240, 260.0, 261.0, 159.5, 119.5)
T_MAP_CAMERA = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))


# --- whole runs -----------------------------------------------------------------------------------
@pytest.fixture
def refined(finished_run: Path, tmp_path: Path) -> Path:
    """A copy of the run with a refined map that equals its own."""
    run = shutil.copytree(finished_run, tmp_path / "run")
    (run / "refined").mkdir()
    for name in MAP_FILES:
        shutil.copy(run / name, run / "refined")
    return run


def test_finished_run_is_read_back(finished_run: Path, room_folder: Path) -> None:
    run = read_run(finished_run)
    run.require_source(open_sequence(str(room_folder)))
    assert [frame.index for frame in run.frames if frame.is_held_out] == [4, 9, 14]
    assert list(run.estimates) == ["online", "final"]
    (posed,) = run.maps
    assert posed.rows.shape[1] == 16
    assert len(posed.rows) > 10_000
    np.testing.assert_array_equal(
        posed.T_map_camera(run.frame(9)), run.estimates["final"].T_world_camera[9]
    )


def test_refined_map_is_read_with_its_own_poses(refined: Path) -> None:
    poses = Trajectory.load(refined / "trajectory.txt")
    moved = poses.T_world_camera.copy()
    moved[:, 0, 3] += 0.5
    Trajectory(poses.stamps_s, moved).save(refined / "refined/trajectory.txt")
    run = read_run(refined)
    assert [posed.name for posed in run.maps] == ["online", "refined"]
    assert list(run.estimates) == ["online", "final", "refined"]
    first, second = (posed.T_map_camera(run.frame(3)) for posed in run.maps)
    assert second[0, 3] - first[0, 3] == pytest.approx(0.5, abs=1e-6)


def test_run_that_replaces_a_refined_one_has_no_refined_map(
    refined: Path, finished_run: Path
) -> None:
    prepare(refined, overwrite=True)
    shutil.copytree(finished_run, refined, dirs_exist_ok=True)
    assert [posed.name for posed in read_run(refined).maps] == ["online"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def overwrite(path: Path) -> None:
    path.write_text("something else\n1,2\n")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("map.ply", Path.unlink),
        ("map.ply", truncate),
        ("map.ply", overwrite),
        ("frames.csv", Path.unlink),
        ("frames.csv", overwrite),
        ("trajectory.txt", Path.unlink),
        ("trajectory.txt", overwrite),
        ("keyframes.json", Path.unlink),
        ("keyframes.json", overwrite),
        ("trajectory_online.txt", Path.unlink),
        ("refined/map.ply", truncate),
        ("refined/trajectory.txt", Path.unlink),
    ],
)
def test_missing_or_damaged_file_is_named_in_the_error(
    refined: Path, name: str, damage: Callable[[Path], None]
) -> None:
    damage(refined / name)
    with pytest.raises(DataError, match=Path(name).name) as caught:
        read_run(refined)
    assert str((refined / name).parent) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- maps -----------------------------------------------------------------------------------------
def keyframe(**changes: object) -> dict[str, object]:
    camera = {name: getattr(SOME_CAMERA, name) for name in CAMERA}
    return {"keyframe": 0, "camera": camera, "T_map_camera": T_MAP_CAMERA.tolist(), **changes}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_ply(tmp_path / "map.ply", np.zeros((0, 16), np.float32))
    (tmp_path / "keyframes.json").write_text(json.dumps([keyframe(), keyframe(keyframe=1)]))
    return tmp_path


def test_viewpoints_have_camera_and_pose_of_the_keyframes(folder: Path) -> None:
    first, _ = MapFolder(folder).viewpoints()
    assert first.camera == SOME_CAMERA
    np.testing.assert_array_equal(first.T_map_camera, T_MAP_CAMERA)


def test_keyframes_without_exposure_have_unit_gain(folder: Path) -> None:
    np.testing.assert_array_equal(MapFolder(folder).exposures().at(0).gain, np.ones(3))


def test_refined_map_is_preferred_once_it_exists(folder: Path) -> None:
    assert newest_map(folder).folder == folder
    (folder / "refined").mkdir()
    assert newest_map(folder).folder == folder  # The folder is still empty.
    write_ply(folder / "refined" / "map.ply", np.zeros((0, 16), np.float32))
    assert newest_map(folder).folder == folder / "refined"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"T_map_camera": np.eye(3).tolist()}, "must be a 4x4 matrix of finite"),
        ({"T_map_camera": np.full((4, 4), np.nan).tolist()}, "must be a 4x4 matrix of finite"),
        ({"camera": {"width": 320}}, "height"),
        ({"camera": [1, 2]}, "not have the format that `ldo run` writes"),
    ],
)
def test_invalid_keyframe_is_refused_with_the_reason(
    folder: Path, changes: dict, reason: str
) -> None:
    (folder / "keyframes.json").write_text(json.dumps([keyframe(**changes)]))
    with pytest.raises(DataError, match=reason):
        MapFolder(folder).viewpoints()
