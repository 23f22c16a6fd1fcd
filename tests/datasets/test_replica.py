import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import DataError, FrameError

Writer = Callable[..., Path]


def test_scale_is_read_from_the_parent_folder(replica_folder: Writer) -> None:
    sequence = open_sequence(str(replica_folder([0, 1, 2])))
    assert sequence.read(1).depth_scale == 6553.5
    np.testing.assert_allclose(sequence[1].depth_m, 2000 / 6553.5, rtol=1e-6)


def test_parameters_in_the_folder_itself_come_first(replica_folder: Writer) -> None:
    folder = replica_folder([0])
    params = json.loads((folder.parent / "cam_params.json").read_text())
    params["camera"]["scale"] = 1000.0
    (folder / "cam_params.json").write_text(json.dumps(params))
    assert open_sequence(str(folder)).read(0).depth_scale == 1000


def test_stamps_are_frame_numbers_at_30_hz(replica_folder: Writer) -> None:
    sequence = open_sequence(str(replica_folder([0, 1, 30])))
    assert sequence.stamps_ns.tolist() == [0, 33_333_333, 1_000_000_000]


def test_truth_belongs_to_the_frames(replica_folder: Writer) -> None:
    sequence = open_sequence(str(replica_folder([0, 1, 2])))
    truth = sequence.truth()
    assert truth is not None
    assert truth.T_world_camera[:, 0, 3].tolist() == [0, 1, 2]
    np.testing.assert_allclose(truth.stamps_s * 1e9, sequence.stamps_ns)


def test_truth_follows_frame_numbers_where_frames_are_missing(replica_folder: Writer) -> None:
    folder = replica_folder([0, 2, 5])
    (folder / "results/depth000002.png").unlink()
    sequence, truth = open_sequence(str(folder)), open_sequence(str(folder)).truth()
    assert len(sequence) == 2
    assert truth is not None
    assert truth.T_world_camera[:, 0, 3].tolist() == [0, 5]


def test_truth_of_fewer_lines_than_frames_covers_the_first(replica_folder: Writer) -> None:
    folder = replica_folder([0, 1, 2])
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join(lines[:2]))
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    assert len(truth) == 2


def test_sequence_without_trajectory_has_no_truth(replica_folder: Writer) -> None:
    folder = replica_folder([0])
    (folder / "traj.txt").unlink()
    assert open_sequence(str(folder)).truth() is None


@pytest.mark.parametrize("line", ["1 2 3", "x " * 16, "nan " * 16, "2 " * 16])
def test_trajectory_line_that_is_no_pose_is_named(replica_folder: Writer, line: str) -> None:
    folder = replica_folder([0])
    (folder / "traj.txt").write_text(line + "\n")
    with pytest.raises(DataError, match=r"traj\.txt, line 1"):
        open_sequence(str(folder)).truth()


def test_missing_parameters_name_both_paths(replica_folder: Writer) -> None:
    folder = replica_folder([0], params=None)
    with pytest.raises(DataError, match=r"office0/cam_params\.json nor"):
        open_sequence(str(folder))


@pytest.mark.parametrize("params", [{}, {"scale": 1000}, {"w": 4, "h": 4}])
def test_incomplete_parameters_are_named(replica_folder: Writer, params: dict) -> None:
    with pytest.raises(DataError, match=r"cam_params\.json: expected a finite number"):
        open_sequence(str(replica_folder([0], params=params)))


def test_folder_without_frames_is_a_data_error(replica_folder: Writer) -> None:
    with pytest.raises(DataError, match="0 color and 0 depth images"):
        open_sequence(str(replica_folder([])))


def test_truncated_jpeg_fails_alone(replica_folder: Writer) -> None:
    folder = replica_folder([0, 1])
    path = folder / "results/frame000000.jpg"
    path.write_bytes(path.read_bytes()[:-40])
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match="truncated"):
        sequence.read(0)
    assert sequence[1].index == 1


def test_real_apartment_reads(data: Path) -> None:
    sequence = open_sequence(str(data / "replica/apartment_floor1"))
    assert len(sequence) == 275
    truth = sequence.truth()
    assert truth is not None
    assert len(truth) == 275
    assert 0.5 < np.median(sequence[100].depth_m) < 10
