import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import SequenceOptions, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, se3

Writer = Callable[..., Path]
DEPTH_CAMERA = Camera(24, 16, 20.0, 21.0, 11.5, 7.5)
COLOR_CAMERA = Camera(48, 32, 40.0, 42.0, 23.5, 15.5)


def test_larger_color_is_resampled_to_the_depth_image(scannet_folder: Writer) -> None:
    sequence = open_sequence(str(scannet_folder([0, 1])))
    assert sequence.camera == DEPTH_CAMERA
    raw = sequence.read(1)
    assert raw.color.shape == (16, 24, 3)
    assert raw.depth.dtype == np.uint16
    assert np.all(raw.depth == 2000)
    assert np.all(np.abs(raw.color.astype(int) - [15, 0, 200]) <= 6)  # JPEG
    np.testing.assert_allclose(sequence[1].depth_m, 2.0, rtol=1e-7)


def test_files_are_ordered_by_number_and_not_by_name(scannet_folder: Writer) -> None:
    sequence = open_sequence(str(scannet_folder([0, 1, 2, 10, 11])))
    assert [int(sequence.read(k).depth[8, 12]) for k in range(5)] == [1e3, 2e3, 3e3, 11e3, 12e3]


def test_gap_in_the_numbers_is_a_gap_in_time_and_not_in_the_indices(scannet_folder: Writer) -> None:
    sequence = open_sequence(str(scannet_folder([0, 20, 60])))
    assert [sequence.read(k).index for k in range(3)] == [0, 1, 2]
    assert sequence.stamps_ns.tolist() == [0, 666_666_666, 2_000_000_000]


def test_image_without_partner_is_skipped(scannet_folder: Writer) -> None:
    folder = scannet_folder([0, 1, 2, 3])
    (folder / "color/1.jpg").unlink()
    (folder / "depth/2.png").unlink()
    sequence = open_sequence(str(folder))
    assert [int(sequence.read(k).depth[8, 12]) for k in range(len(sequence))] == [1000, 4000]
    truth = sequence.truth()
    assert truth is not None
    assert truth.T_world_camera[:, 0, 3].tolist() == [0.0, 3.0]


def test_frame_without_a_valid_pose_has_no_truth(
    scannet_folder: Writer, write_matrix: Callable[..., None]
) -> None:
    folder = scannet_folder([0, 1, 2])
    write_matrix(folder / "pose/1.txt", np.full((4, 4), -np.inf))
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.stamps_s, [0, 2 / 30], atol=1e-9)
    shutil.rmtree(folder / "pose")
    assert open_sequence(str(folder)).truth() is None


def test_broken_pose_file_is_named_with_its_line(scannet_folder: Writer) -> None:
    folder = scannet_folder([0, 1])
    (folder / "pose/1.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n")
    sequence = open_sequence(str(folder))
    with pytest.raises(DataError, match=r"pose/1\.txt, line 3: expected a row of 4 numbers"):
        sequence.truth()


@pytest.mark.parametrize("name", ["color/1.jpg", "depth/1.png"])
def test_damaged_image_is_one_bad_frame(scannet_folder: Writer, name: str) -> None:
    folder = scannet_folder([0, 1, 2])
    (folder / name).write_bytes((folder / name).read_bytes()[:-30])
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=name):
        sequence.read(1)
    assert sequence[2].index == 2


def test_damaged_first_image_does_not_hide_the_size_of_the_others(scannet_folder: Writer) -> None:
    folder = scannet_folder([0, 1])
    (folder / "color/0.jpg").write_bytes(b"")
    assert open_sequence(str(folder))[1].camera == DEPTH_CAMERA


def test_color_of_another_size_than_the_first_is_a_bad_frame(scannet_folder: Writer) -> None:
    folder = scannet_folder([0, 1])
    cv2.imwrite(str(folder / "color/1.jpg"), np.zeros((16, 24, 3), np.uint8))
    with pytest.raises(FrameError, match="color is 24x16 pixels, but its intrinsics are for 48x32"):
        open_sequence(str(folder)).read(1)


def test_depth_outside_the_color_view_is_removed(
    scannet_folder: Writer, write_matrix: Callable[..., None]
) -> None:
    folder = scannet_folder([0])
    K = np.diag([80.0, 84.0, 1.0, 1.0])  # Twice the focal length: color sees the middle half.
    K[0, 2], K[1, 2] = 23.5, 15.5
    write_matrix(folder / "intrinsic/intrinsic_color.txt", K)
    expected = np.zeros((16, 24), np.float32)
    expected[4:12, 6:18] = 1.0
    assert np.array_equal(open_sequence(str(folder))[0].depth_m, expected)


def test_intrinsics_are_required_and_extrinsics_are_not(scannet_folder: Writer) -> None:
    folder = scannet_folder([0])
    for name in ("color", "depth"):
        (folder / f"intrinsic/extrinsic_{name}.txt").unlink()
    assert open_sequence(str(folder)).camera == DEPTH_CAMERA
    (folder / "intrinsic/intrinsic_color.txt").unlink()
    with pytest.raises(DataError, match=r"intrinsic_color\.txt cannot be read"):
        open_sequence(str(folder))


def test_depth_of_a_separate_camera_is_registered_to_color(scannet_folder: Writer) -> None:
    """A wall at 2 m moves by 40 * 0.1 / 2 = 2 color pixels for 0.1 m between the cameras."""
    T_sensor_depth = se3.exp(np.array([0, 0, 0, 0.1, 0, 0]))
    sequence = open_sequence(str(scannet_folder([0, 1], T_sensor_depth)))
    frame = sequence[1]
    assert frame.camera == COLOR_CAMERA
    assert np.all(frame.depth_m[:, :2] == 0)
    assert np.all(frame.depth_m[:, 2:] == 2.0)
    truth = sequence.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera[:, 0, 3], [-0.1, 0.9], atol=1e-12)


def test_depth_is_registered_to_larger_color_on_request(scannet_folder: Writer) -> None:
    folder = scannet_folder([0, 1])
    frame = open_sequence(str(folder), SequenceOptions(register_depth=True))[1]
    assert frame.camera == COLOR_CAMERA
    assert np.all(frame.depth_m == 2.0)


def test_real_frames_in_scannet_sizes_are_read(
    data: Path, tmp_path: Path, write_matrix: Callable[..., None]
) -> None:
    """The color images of the kitchen are enlarged to 1296x968, the size in ScanNet."""
    kitchen = open_sequence(str(data / "tum/kitchen"))
    large = Camera(1296, 968, 525 * 2.025, 525 * 968 / 480, 320.5 * 2.025 - 0.5, 480.487)
    for k in range(3):
        raw = kitchen.read(10 * k)
        color = cv2.resize(raw.color[..., ::-1], (1296, 968), interpolation=cv2.INTER_CUBIC)
        for name in ("color", "depth"):
            (tmp_path / name).mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"color/{10 * k}.jpg"), color)
        cv2.imwrite(str(tmp_path / f"depth/{10 * k}.png"), raw.depth // 5)
    for name, camera in (("color", large), ("depth", kitchen.camera)):
        K = np.eye(4)
        K[:3, :3] = camera.matrix
        write_matrix(tmp_path / f"intrinsic/intrinsic_{name}.txt", K)
    found = open_sequence(str(tmp_path))[2]
    expected = kitchen[20]
    assert np.max(np.abs(found.depth_m - expected.depth_m)) < 0.0011
    assert np.mean(np.abs(found.color.astype(int) - expected.color)) < 4
    assert found.stamp_ns == 20 * 10**9 // 30
