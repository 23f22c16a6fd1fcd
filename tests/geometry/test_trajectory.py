from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from ldo_service.errors import DataError
from ldo_service.geometry import Trajectory, se3


def some_trajectory(count: int = 20) -> Trajectory:
    rng = np.random.default_rng(0)
    poses = np.array([se3.exp(rng.normal(0, 1, 6)) for _ in range(count)])
    return Trajectory(1305031102.175304 + np.arange(count) / 30, poses)


def test_saved_trajectory_loads_unchanged(tmp_path: Path) -> None:
    before = some_trajectory()
    before.save(tmp_path / "t.txt")
    after = Trajectory.load(tmp_path / "t.txt")
    np.testing.assert_allclose(after.T_world_camera, before.T_world_camera, atol=1e-8)
    np.testing.assert_allclose(after.stamps_s, before.stamps_s, atol=1e-6)


def test_evo_reads_what_is_saved(tmp_path: Path) -> None:
    ours = some_trajectory()
    ours.save(tmp_path / "t.txt")
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "t.txt"))
    np.testing.assert_allclose(np.array(theirs.poses_se3), ours.T_world_camera, atol=1e-8)


def test_empty_trajectory_survives_the_file(tmp_path: Path) -> None:
    Trajectory(np.zeros(0), np.zeros((0, 4, 4))).save(tmp_path / "t.txt")
    assert len(Trajectory.load(tmp_path / "t.txt")) == 0


def test_lines_out_of_order_are_sorted_and_comments_skipped(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# a comment\n2 2 0 0 0 0 0 1\n\n1 1 0 0 0 0 0 2\n")
    loaded = Trajectory.load(path)
    assert loaded.stamps_s.tolist() == [1, 2]
    np.testing.assert_array_equal(loaded.T_world_camera[0, :3, :3], np.eye(3))


@pytest.mark.parametrize(
    "line", ["1 2 3", "1 0 0 0 0 0 zero 1", "1 nan 0 0 0 0 0 1", "1 0 0 0 0 0 0 0"]
)
def test_unreadable_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(DataError, match="line 2"):
        Trajectory.load(path)


def test_missing_file_is_a_data_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere"):
        Trajectory.load(tmp_path / "nowhere.txt")


def test_descending_stamps_and_unequal_lengths_are_rejected() -> None:
    with pytest.raises(DataError, match="ascend"):
        Trajectory(np.array([2.0, 1.0]), np.zeros((2, 4, 4)))
    with pytest.raises(DataError, match="expected"):
        Trajectory(np.array([1.0, 2.0]), np.zeros((3, 4, 4)))
