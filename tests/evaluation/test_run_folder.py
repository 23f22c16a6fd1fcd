"""A folder that `ldo run` wrote, and folders that something happened to."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.errors import DataError
from ldo_service.evaluation.run_folder import FinishedRun, at_stamps
from ldo_service.geometry import Trajectory


@pytest.fixture
def copied(finished_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished_run, tmp_path / "run")


def test_a_run_is_read_as_it_was(finished_run: Path, room_folder: Path) -> None:
    run = FinishedRun.read(finished_run)
    run.require_source(open_sequence(str(room_folder)))
    assert [frame.index for frame in run.frames if frame.is_held_out] == [4, 9, 14]
    assert list(run.estimates) == ["online", "final"]
    (posed,) = run.maps
    assert posed.rows.shape[1] == 16
    assert len(posed.rows) > 10_000
    np.testing.assert_array_equal(
        posed.T_map_camera(run.frame(9)), run.estimates["final"].T_world_camera[9]
    )


def test_a_refined_map_is_another_with_poses_of_its_own(copied: Path) -> None:
    (copied / "refined").mkdir()
    for name in ("map.ply", "keyframes.json"):
        shutil.copy(copied / name, copied / "refined")
    poses = Trajectory.load(copied / "trajectory.txt")
    moved = poses.T_world_camera.copy()
    moved[:, 0, 3] += 0.5
    Trajectory(poses.stamps_s, moved).save(copied / "refined/trajectory.txt")
    run = FinishedRun.read(copied)
    assert [posed.name for posed in run.maps] == ["online", "refined"]
    assert list(run.estimates) == ["online", "final", "refined"]
    online, refined = (posed.T_map_camera(run.frame(3)) for posed in run.maps)
    assert refined[0, 3] - online[0, 3] == pytest.approx(0.5, abs=1e-6)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def overwrite(path: Path) -> None:
    path.write_text("something else\n1,2\n")


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("map.ply", Path.unlink),
        ("map.ply", cut),
        ("map.ply", overwrite),
        ("frames.csv", Path.unlink),
        ("frames.csv", overwrite),
        ("trajectory.txt", Path.unlink),
        ("trajectory.txt", overwrite),
        ("trajectory_online.txt", Path.unlink),
        ("refined/map.ply", lambda path: path.parent.mkdir()),
    ],
)
def test_a_file_that_is_missing_or_spoilt_is_named(
    copied: Path, name: str, spoil: Callable[[Path], None]
) -> None:
    spoil(copied / name)
    with pytest.raises(DataError, match=Path(name).name) as caught:
        FinishedRun.read(copied)
    assert "\n" not in str(caught.value)


def test_a_frame_that_should_have_a_pose_and_has_none_is_an_error(copied: Path) -> None:
    lines = (copied / "trajectory.txt").read_text().splitlines()
    (copied / "trajectory.txt").write_text("\n".join(lines[:7] + lines[8:]))
    run = FinishedRun.read(copied)
    with pytest.raises(DataError, match=r"no pose for frame 7.*calls OK"):
        run.maps[0].T_map_camera(run.frame(7))


def test_another_source_is_refused(finished_run: Path, room: Sequence, room_folder: Path) -> None:
    run = FinishedRun.read(finished_run)
    later = replace(run.frames[3], stamp_ns=run.frames[3].stamp_ns + 1)
    beyond = replace(run.frames[3], index=16)
    sequence = open_sequence(str(room_folder))
    for frame in (later, beyond):
        with pytest.raises(DataError, match="the SOURCE that the run was made from"):
            replace(run, frames=(*run.frames[:3], frame)).require_source(sequence)
    assert len(room) > 16


def test_poses_are_chosen_by_stamp() -> None:
    poses = Trajectory(
        np.array([1e9, 1e9 + 0.033333333, 1e9 + 0.066666667]), np.tile(np.eye(4), (3, 1, 1))
    )
    assert at_stamps(poses, np.array([1e9 + 0.0333333335])).stamps_s.tolist() == [poses.stamps_s[1]]
    assert len(at_stamps(poses, np.array([1e9 + 0.04]))) == 0
    assert len(at_stamps(poses, np.zeros(0))) == 0
