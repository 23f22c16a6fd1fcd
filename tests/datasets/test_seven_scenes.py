from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import Sequence, SequenceOptions, open_sequence
from ldo_service.datasets.seven_scenes import COLOR_CAMERA, DEPTH_CAMERA, T_COLOR_DEPTH
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.registration import register_depth

Writer = Callable[..., Path]
REGISTERED = SequenceOptions(register_depth=True)


def set_depth(folder: Path, k: int, depth: np.ndarray) -> None:
    assert cv2.imwrite(str(folder / f"frame-{k:06d}.depth.png"), depth.astype(np.uint16))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_frames_equal_the_files(seven_scenes_folder: Writer, suffix: str) -> None:
    sequence = open_sequence(str(seven_scenes_folder([0, 1], suffix)))
    assert sequence.camera == Camera(640, 480, 585, 585, 320, 240)
    raw = sequence.read(1)
    assert np.all(raw.depth == 2000)
    assert np.all(np.abs(raw.color.astype(int) - [15, 0, 200]) <= 6)
    np.testing.assert_allclose(sequence[1].depth_m, 2.0, rtol=1e-7)


def test_both_codes_of_missing_depth_are_read_as_zero(seven_scenes_folder: Writer) -> None:
    folder = seven_scenes_folder([0])
    depth = np.full((480, 640), 3000)
    depth[:100], depth[100:200] = 65535, 0
    set_depth(folder, 0, depth)
    for options in (SequenceOptions(), REGISTERED):
        frame = open_sequence(str(folder), options)[0]
        assert np.all(frame.depth_m[:190] == 0)
        assert set(np.unique(frame.depth_m)) == {np.float32(0), np.float32(3)}


def test_own_intrinsics_are_those_of_the_depth_camera(
    seven_scenes_folder: Writer, write_matrix: Callable[..., None]
) -> None:
    folder = seven_scenes_folder([0])
    K = np.array([[570, 0, 319], [0, 571, 241], [0, 0, 1.0]])
    write_matrix(folder.parent / "camera-intrinsics.txt", K)
    assert open_sequence(str(folder)).camera == Camera(640, 480, 570, 571, 319, 241)
    K[0, 0] = 560
    write_matrix(folder / "camera-intrinsics.txt", K)
    assert open_sequence(str(folder)).camera == Camera(640, 480, 560, 571, 319, 241)
    assert open_sequence(str(folder), REGISTERED).camera == COLOR_CAMERA
    (folder / "camera-intrinsics.txt").write_text("570 0 319\n0 571\n0 0 1\n")
    with pytest.raises(DataError, match=r"camera-intrinsics\.txt, line 2"):
        open_sequence(str(folder))


def test_registered_depth_moves_to_the_color_camera(seven_scenes_folder: Writer) -> None:
    """A point 1 m ahead of the depth camera is 0.0254 * 525 = 13.3 px left in color."""
    folder = seven_scenes_folder([0])
    depth = np.zeros((480, 640))
    depth[240, 320] = 1000
    set_depth(folder, 0, depth)
    sequence = open_sequence(str(folder), REGISTERED)
    frame = sequence[0]
    assert frame.camera == COLOR_CAMERA
    assert np.argwhere(frame.depth_m).tolist() == [[238, 307]]
    truth = sequence.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera[0, :3, 3], [0.0254, 0, 0], atol=1e-12)


def test_calibration_can_be_replaced(seven_scenes_folder: Writer) -> None:
    folder = seven_scenes_folder([0])
    camera = Camera(640, 480, 500, 500, 320, 240)
    aligned = replace(REGISTERED, color_camera=camera, depth_camera=camera, T_color_depth=np.eye(4))
    frame = open_sequence(str(folder), aligned)[0]
    assert frame.camera == camera
    assert np.all(frame.depth_m == 1)
    unregistered = SequenceOptions(depth_camera=camera)
    assert open_sequence(str(folder), unregistered).camera == camera


def test_gap_in_the_numbers_is_a_gap_in_time_and_not_in_the_indices(
    seven_scenes_folder: Writer,
) -> None:
    folder = seven_scenes_folder([3, 6, 9, 12])
    (folder / "frame-000009.depth.png").unlink()
    sequence = open_sequence(str(folder))
    assert [sequence.read(k).index for k in range(len(sequence))] == [0, 1, 2]
    assert sequence.stamps_ns.tolist() == [100_000_000, 200_000_000, 400_000_000]
    truth = sequence.truth()
    assert truth is not None
    assert truth.T_world_camera[:, 0, 3].tolist() == [3, 6, 12]


def test_pose_is_not_required_and_a_broken_one_is_named(seven_scenes_folder: Writer) -> None:
    folder = seven_scenes_folder([0, 1])
    (folder / "frame-000000.pose.txt").unlink()
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    assert len(truth) == 1
    (folder / "frame-000001.pose.txt").write_text("1 0 0 0\nhello\n")
    with pytest.raises(DataError, match=r"frame-000001\.pose\.txt, line 2"):
        open_sequence(str(folder)).truth()


@pytest.mark.parametrize("name", ["frame-000001.color.png", "frame-000001.depth.png"])
def test_damaged_image_is_one_bad_frame(seven_scenes_folder: Writer, name: str) -> None:
    folder = seven_scenes_folder([0, 1])
    (folder / name).write_bytes(b"no image, but long enough")
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=name):
        sequence.read(1)
    assert sequence[0].index == 0


@pytest.mark.parametrize("options", [SequenceOptions(), REGISTERED])
def test_depth_of_another_size_is_a_bad_frame(
    seven_scenes_folder: Writer, options: SequenceOptions
) -> None:
    folder = seven_scenes_folder([0, 1])
    set_depth(folder, 1, np.ones((240, 320)))
    with pytest.raises(FrameError, match="320x240"):
        open_sequence(str(folder), options).read(1)


def test_color_without_any_depth_is_an_error(seven_scenes_folder: Writer) -> None:
    folder = seven_scenes_folder([0])
    (folder / "frame-000000.depth.png").unlink()
    with pytest.raises(DataError, match="1 color and 0 depth images"):
        open_sequence(str(folder))


def write_unregistered(kitchen: Sequence, indices: list[int], folder: Path) -> Path:
    """Write RedKitchen as its Kinect delivered it, from frames with registered depth."""
    truth = kitchen.truth()
    assert truth is not None
    for k in indices:
        frame = kitchen[k]
        back = se3.inverse(T_COLOR_DEPTH)
        depth_mm = 1000 * register_depth(frame.depth_m, kitchen.camera, DEPTH_CAMERA, back)
        depth_mm[depth_mm == 0] = 65535
        set_depth(folder, k, np.rint(depth_mm))
        cv2.imwrite(str(folder / f"frame-{k:06d}.color.png"), frame.color[..., ::-1])
        nearest = int(np.argmin(np.abs(truth.stamps_s - frame.stamp_ns / 1e9)))
        T_world_depth = truth.T_world_camera[nearest] @ T_COLOR_DEPTH
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", T_world_depth)
    return folder


def test_unregistered_real_kitchen_is_registered(data: Path, tmp_path: Path) -> None:
    kitchen = open_sequence(str(data / "tum/kitchen"))
    folder = write_unregistered(kitchen, [0, 300], tmp_path)
    sequence, expected = open_sequence(str(folder), REGISTERED), kitchen[300]
    frame = sequence[1]
    both = (frame.depth_m > 0) & (expected.depth_m > 0)
    error_m = np.abs(frame.depth_m - expected.depth_m)[both]
    assert both.sum() > 0.95 * (expected.depth_m > 0).sum()
    assert np.median(error_m) < 0.002
    assert np.mean(error_m > 0.05) < 0.02  # The rims of foreground objects.
    without_registration = open_sequence(str(folder))[1].depth_m
    both = (without_registration > 0) & (expected.depth_m > 0)
    unregistered_error_m = np.abs(without_registration - expected.depth_m)[both]
    assert np.median(unregistered_error_m) > 5 * np.median(error_m)
    assert np.array_equal(frame.color, expected.color)
    truth, known = sequence.truth(), kitchen.truth()
    assert truth is not None
    assert known is not None
    np.testing.assert_allclose(truth.T_world_camera[0], known.T_world_camera[0], atol=1e-9)
