"""KITTI odometry: depth from stereo, calibration, and poses of the left color camera."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.datasets.kitti import MIN_DISPARITY_PX
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, se3
from ldo_service.synthetic.room_sequence import SyntheticSequence

from .recordings import write_image, write_kitti

BASELINE_M = 0.12
FRAMES = 0, 40, 80


@pytest.fixture(scope="module")
def room() -> SyntheticSequence:
    return SyntheticSequence.named("room")


@pytest.fixture(scope="module")
def rendered(room: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of KITTI with stereo pairs of the room."""
    indices = list(FRAMES)
    T_world_camera = room.truth().T_world_camera[indices]
    return write_kitti(
        tmp_path_factory.mktemp("sequences") / "00",
        [stereo(room, T) for T in T_world_camera],
        room.raw_camera,
        BASELINE_M,
        room.stamps_ns[indices],
        T_world_camera,
    )


def stereo(room: SyntheticSequence, T_world_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the images of the left camera and of one to its right."""
    T_left_right = np.eye(4)
    T_left_right[0, 3] = BASELINE_M
    poses = T_world_left, T_world_left @ T_left_right
    left, right = (room._renderer.render(room.raw_camera, T).color for T in poses)
    return left, right


def copy(folder: Path, to: Path) -> Path:
    """Copy the text files of a folder, and link its images."""
    to.mkdir(parents=True)
    for path in folder.iterdir():
        if path.is_dir():
            (to / path.name).symlink_to(path)
        else:
            (to / path.name).write_bytes(path.read_bytes())
    return to


def test_depth_of_a_rendered_room_is_right_within_a_quarter_of_a_pixel(
    room: SyntheticSequence, rendered: Path
) -> None:
    sequence = open_sequence(str(rendered))
    assert (sequence.name, sequence.raw_camera) == ("00", room.raw_camera)
    assert sequence.registration == "reader"
    np.testing.assert_array_equal(sequence.stamps_ns, room.stamps_ns[list(FRAMES)])
    for k, index in enumerate(FRAMES):
        raw, exact = sequence.read(k), room.read(index)
        np.testing.assert_array_equal(raw.color, exact.color)
        depth_m, true_m = raw.depth_m(), exact.depth_m()
        is_known = depth_m > 0
        assert is_known.mean() > 0.8
        scale = room.raw_camera.fx * BASELINE_M
        error_px = np.abs(scale / depth_m[is_known] - scale / true_m[is_known])
        assert np.median(error_px) < 0.25
        assert np.mean(error_px > 2) < 0.02


def test_depth_beyond_the_minimum_disparity_is_left_out(tmp_path: Path) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (64, 400, 1), np.uint8).repeat(3, 2)
    texture = cv2.GaussianBlur(texture, (0, 0), 1)
    camera = Camera(320, 64, 300.0, 300.0, 159.5, 31.5)
    pairs = [(texture[:, 20:340], texture[:, 20 + d : 340 + d]) for d in (4, 8)]
    stamps_ns, poses = np.array([0, 10**8]), np.tile(np.eye(4), (2, 1, 1))
    folder = write_kitti(tmp_path / "01", pairs, camera, 0.5, stamps_ns, poses)
    sequence = open_sequence(str(folder))
    far, near = (sequence.read(k).depth_m() for k in range(2))
    assert 4 < MIN_DISPARITY_PX < 8
    assert not far.any()
    assert np.median(near[near > 0]) == pytest.approx(300 * 0.5 / 8, rel=0.02)


def test_truth_is_that_of_the_left_color_camera(
    room: SyntheticSequence, rendered: Path, tmp_path: Path
) -> None:
    expected = room.truth().T_world_camera[list(FRAMES)]
    truth = open_sequence(str(rendered)).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, expected, atol=1e-9)
    folder = copy(rendered, tmp_path / "sequences/07")
    (tmp_path / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "poses/07.txt")
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, expected, atol=1e-9)
    (tmp_path / "poses/07.txt").unlink()
    assert open_sequence(str(folder)).truth() is None


def test_gray_cameras_are_read_if_there_are_no_color_cameras(
    rendered: Path, tmp_path: Path
) -> None:
    folder = copy(rendered, tmp_path / "gray")
    for old, new in (("image_2", "image_0"), ("image_3", "image_1")):
        (folder / old).rename(folder / new)
    sequence = open_sequence(str(folder))
    truth = sequence.truth()
    assert truth is not None
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)  # Camera 0 is the left gray one.
    np.testing.assert_allclose(truth.T_world_camera[:, :3], poses, atol=1e-9)
    assert sequence.read(0).depth_m().any()


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("calib.txt", "P3:", "P9:", r"calib\.txt has no line `P3: 12 numbers`"),
        ("calib.txt", "P2: ", "P2: x ", r"calib\.txt has no line `P2: 12 numbers`"),
        ("calib.txt", None, "", r"calib\.txt has no line `P2"),
        (
            "times.txt",
            None,
            "0.0\nx\n",
            r"times\.txt, line 2: expected a time in seconds, found 'x'",
        ),
        ("times.txt", None, "1\n1\n1\n", r"times\.txt, line 2: the time 1 s is not later"),
        ("times.txt", None, "0\n", r"times\.txt has 1 lines, expected at least 3"),
        ("poses.txt", None, "1 2 3\n", r"poses\.txt, line 1: expected 12 numbers"),
        ("poses.txt", None, "1 0 0 0 0 1 0 0 0 0 1 0\n", r"poses\.txt has 1 lines"),
        ("poses.txt", None, "2 0 0 0 0 1 0 0 0 0 1 0\n", "expected 12 numbers, the first three"),
    ],
)
def test_invalid_file_is_named(
    rendered: Path, tmp_path: Path, name: str, old: str | None, new: str, message: str
) -> None:
    path = copy(rendered, tmp_path / "00") / name
    path.write_text(new if old is None else path.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        open_sequence(str(path.parent)).truth()


def test_cameras_that_are_no_pair_are_named(rendered: Path, tmp_path: Path) -> None:
    path = copy(rendered, tmp_path / "00") / "calib.txt"
    path.write_text(path.read_text().replace("P2", "P5").replace("P3", "P2").replace("P5", "P3"))
    with pytest.raises(DataError, match=r"P2 and P3 are not the cameras.*baseline is -0\.12"):
        open_sequence(str(path.parent))


def test_folder_without_a_right_image_is_named(tmp_path: Path, rendered: Path) -> None:
    folder = copy(rendered, tmp_path / "00")
    (folder / "image_3").unlink()
    with pytest.raises(DataError, match="3 images in image_2/ and 0 in image_3/"):
        open_sequence(str(folder))


def test_images_of_two_sizes_are_one_bad_frame(tmp_path: Path) -> None:
    camera, image = Camera(64, 48, 50.0, 50.0, 31.5, 23.5), np.zeros((48, 64, 3), np.uint8)
    poses = np.tile(se3.exp(np.zeros(6)), (2, 1, 1))
    folder = write_kitti(
        tmp_path / "00", [(image, image)] * 2, camera, 0.5, np.array([0, 10**8]), poses
    )
    write_image(folder / "image_3/000001.png", image[:40])
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=r"is 64x48 pixels and .*000001\.png 64x40"):
        sequence.read(1)
    assert sequence.read(0).index == 0
