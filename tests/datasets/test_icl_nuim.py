"""ICL-NUIM in both layouts: images of a camera with y down, and mirrored ground truth."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.datasets.icl_nuim import CAMERA
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import RawFrame, se3

from .recordings import write_icl_nuim, write_icl_nuim_rendered

DEPTH_M = np.linspace(1, 4, CAMERA.height)[:, None].repeat(CAMERA.width, 1)
FRAMES = [
    RawFrame(k, 0, np.full((480, 640, 3), 50 * k, np.uint8), DEPTH_M + k, 1.0, CAMERA)
    for k in range(2)
]
POSES = np.array([se3.exp(k * np.array([0.3, 0.2, -0.1, 0.5, 1.0, -0.2])) for k in range(2)])
WRITERS = {"PNG": write_icl_nuim, "rendered": write_icl_nuim_rendered}


@pytest.fixture(params=WRITERS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return WRITERS[request.param](tmp_path / "lr_kt0", FRAMES, POSES)


def test_frames_are_those_of_the_folder(folder: Path) -> None:
    sequence = open_sequence(str(folder))
    assert sequence.name == "lr_kt0"
    assert (sequence.raw_camera.fx, sequence.raw_camera.fy) == (481.2, 480.0)
    assert sequence.stamps_ns.tolist() == [0, 33_333_333]
    for k, expected in enumerate(FRAMES):
        raw = sequence.read(k)
        np.testing.assert_array_equal(raw.color, expected.color)
        np.testing.assert_allclose(raw.depth_m(), expected.depth_m(), atol=1.01e-4)


def test_truth_has_the_axes_of_this_project(folder: Path) -> None:
    """The file has left-handed poses with y up; the reader mirrors the y axis."""
    sequence = open_sequence(str(folder))
    truth = sequence.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, POSES, atol=1e-8)
    np.testing.assert_allclose(truth.stamps_s, sequence.stamps_ns * 1e-9, atol=1e-9)


def test_published_pose_is_mirrored(tmp_path: Path) -> None:
    """The camera is at y = 1, where y of ICL-NUIM is up, and is turned by +90 degrees around z."""
    folder = write_icl_nuim(tmp_path / "a", FRAMES, POSES)
    half = np.sqrt(0.5)
    (folder / "livingRoom0.gt.freiburg").write_text(f"1 0 1 2 0 0 {half} {half}\n")
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    expected = [[0, 1, 0, 0], [-1, 0, 0, -1], [0, 0, 1, 2], [0, 0, 0, 1]]
    np.testing.assert_allclose(truth.T_world_camera[0], expected, atol=1e-12)
    assert truth.stamps_s.tolist() == [pytest.approx(1 / 30)]


def test_folder_without_truth_has_none_and_two_files_are_named(folder: Path) -> None:
    path = folder / "livingRoom0.gt.freiburg"
    (folder / "traj1.gt.freiburg").write_bytes(path.read_bytes())
    with pytest.raises(DataError, match=r"2 files \*\.gt\.freiburg: livingRoom0.*, traj1"):
        open_sequence(str(folder)).truth()
    for file in folder.glob("*.freiburg"):
        file.unlink()
    assert open_sequence(str(folder)).truth() is None


@pytest.mark.parametrize(
    "line", ["1 depth/1.png", "x depth/1.png 1 rgb/1.png", "1 ../depth/1.png 1 rgb/1.png"]
)
def test_invalid_association_is_named(tmp_path: Path, line: str) -> None:
    folder = write_icl_nuim(tmp_path / "a", FRAMES, POSES)
    (folder / "associations.txt").write_text(f"0 depth/0.png 0 rgb/0.png\n{line}\n")
    with pytest.raises(
        DataError, match=r"associations\.txt, line 2: expected a line such as `1 depth/1.png"
    ):
        open_sequence(str(folder))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_text("1 2 3"), "has 3 numbers, expected 640x480"),
        (lambda path: path.write_text("1 x 3"), "cannot be read as numbers"),
        (lambda path: path.write_bytes(b"1 " * (9 << 20)), "more than 16777216 bytes"),
    ],
)
def test_damaged_depth_is_one_bad_frame(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    folder = write_icl_nuim_rendered(tmp_path / "a", FRAMES, POSES)
    damage(folder / "scene_00_0001.depth")
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=rf"scene_00_0001\.depth.*{message}"):
        sequence.read(1)
    assert sequence.read(0).index == 0
