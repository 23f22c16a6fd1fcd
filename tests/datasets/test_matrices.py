from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets.files import read_intrinsics, read_matrix, read_trajectory, read_transform
from ldo_service.errors import DataError
from ldo_service.geometry import Camera, se3

T = se3.exp(np.array([0.1, -0.7, 0.3, 1.0, 2.0, -3.0]))


def write(path: Path, matrix: np.ndarray, form: str = "%.6f") -> Path:
    np.savetxt(path, matrix, form)
    return path


def test_transform_of_six_decimals_becomes_a_rotation(tmp_path: Path) -> None:
    found = read_transform(write(tmp_path / "a.txt", T))
    assert found is not None
    np.testing.assert_allclose(found, T, atol=2e-6)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("word", ["-inf", "inf", "nan", "-1.#INF", "1.#QNAN", "-1.#IND000"])
def test_pose_with_a_non_finite_number_is_unknown(tmp_path: Path, word: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(f"{word} 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert read_transform(path) is None


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("1 0 0 0\n0 1 0 x\n0 0 1 0\n0 0 0 1\n", 2),
        ("1 0 0 0\n\n0 1 0\n0 0 1 0\n0 0 0 1\n", 3),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", 3),
        ("", 0),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n0 0 0 1\n", 5),
        ("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", 1),
    ],
)
def test_file_that_is_no_transform_is_named_with_its_line(
    tmp_path: Path, text: str, line: int
) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=rf"a\.txt, line {line}:"):
        read_transform(path)


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    for name in ("a.txt", "b.txt"):
        with pytest.raises(DataError, match=rf"{name[0]}\.txt cannot be read"):
            read_matrix(tmp_path / name, 3)


def test_intrinsics_are_a_camera_of_the_image(tmp_path: Path) -> None:
    path = write(tmp_path / "k.txt", np.array([[585, 0, 320], [0, 586, 240], [0, 0, 1.0]]))
    assert read_intrinsics(path, 3, (640, 480)) == Camera(640, 480, 585, 586, 320, 240)
    with pytest.raises(DataError, match=r"k\.txt has invalid intrinsics: cx=320 px is far outside"):
        read_intrinsics(path, 3, (64, 48))


def test_trajectory_skips_frames_without_a_pose(tmp_path: Path) -> None:
    unknown = np.full((4, 4), -np.inf)
    paths = [tmp_path / f"{k}.txt" for k in range(4)]
    write(paths[0], unknown), write(paths[1], T), write(paths[3], np.eye(4))
    found = read_trajectory(np.array([0, 1, 2, 3]) * 10**9, paths)
    assert found is not None
    assert found.stamps_s.tolist() == [1.0, 3.0]
    np.testing.assert_allclose(found.T_world_camera, [T, np.eye(4)], atol=2e-6)
    assert read_trajectory(np.array([0, 2]), [paths[0], paths[2]]) is None
