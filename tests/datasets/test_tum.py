import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.datasets.tum import PUBLISHED_CAMERAS
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera

Writer = Callable[..., Path]


def test_frames_are_read_in_camera_units_and_rectified_in_meters(tum_folder: Writer) -> None:
    sequence = open_sequence(str(tum_folder(["1.0", "1.1"], ["1.01", "1.11"])))
    assert (len(sequence), sequence.name) == (2, "desk")
    raw, frame = sequence.read(1), sequence[1]
    assert raw.depth.dtype == np.uint16
    assert (raw.depth == 2000).all()
    assert raw.depth_scale == 5000
    assert raw.color[0, 0].tolist() == [15, 0, 200]  # RGB
    np.testing.assert_allclose(frame.depth_m, 0.4)
    assert frame.camera == sequence.camera
    assert (frame.index, frame.stamp_ns) == (1, 1_100_000_000)
    assert [f.index for f in sequence] == [0, 1]


def test_stamps_keep_their_nanoseconds(tum_folder: Writer) -> None:
    stamp = "1305031102.175304001"
    assert open_sequence(str(tum_folder([stamp], [stamp]))).stamps_ns[0] == 1305031102175304001


def test_camera_json_overrides_scale_and_lens(tum_folder: Writer) -> None:
    lens = [0.1, -0.05, 0.001, 0.002, 0.0]
    folder = tum_folder(["1"], ["1"])
    fields = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(
        json.dumps(fields | {"depth_scale": 1000, "distortion": lens})
    )
    sequence = open_sequence(str(folder))
    assert sequence.raw_camera.distortion == tuple(lens)
    assert sequence.camera.distortion == ()
    assert sequence.read(0).depth_scale == 1000
    assert sequence[0].depth_m[8, 12] == 1.0


@pytest.mark.parametrize(
    ("name", "fx", "k1"),
    [("freiburg1", 517.3, 0.2624), ("freiburg2", 520.9, 0.2312), ("freiburg3", 535.4, None)],
)
def test_benchmark_recordings_have_their_published_camera(
    tmp_path: Path, write_tum: Writer, name: str, fx: float, k1: float | None
) -> None:
    folder = tmp_path / f"rgbd_dataset_{name}_desk"
    write_tum(folder, ["1"], ["1"], camera=None, size=(480, 640))
    sequence = open_sequence(str(folder))
    assert sequence.raw_camera.fx == fx
    assert (sequence.raw_camera.distortion or (None,))[0] == k1
    assert sequence[0].depth_m[240, 320] == np.float32(0.2)


def test_unknown_camera_asks_for_camera_json(tum_folder: Writer) -> None:
    with pytest.raises(DataError, match=r"camera\.json with content such as.*fx"):
        open_sequence(str(tum_folder(["1"], ["1"], camera=None)))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fx": None}, '"fx"'),
        ({"fy": -1.0}, "focal"),
        ({"distortion": "none"}, "distortion"),
        ({"depth_scale": 0}, "depth scale"),
        ({"width": 64.5}, 'expected an integer under "width"'),
        ({"width": "wide"}, '"width"'),
    ],
)
def test_broken_calibration_is_named(tum_folder: Writer, change: dict, word: str) -> None:
    folder = tum_folder(["1"], ["1"])
    fields = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(fields | change))
    with pytest.raises(DataError, match=word):
        open_sequence(str(folder))


def test_camera_json_that_is_not_json_is_named(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"])
    (folder / "camera.json").write_text("fx=525")
    with pytest.raises(DataError, match=r"camera\.json cannot be read"):
        open_sequence(str(folder))


def test_color_without_depth_partner_is_skipped(
    tum_folder: Writer, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folder = tum_folder(["1.00", "1.10", "1.20"], ["1.00", "1.121", "1.22"])
    sequence = open_sequence(str(folder))
    assert sequence.stamps_ns.tolist() == [1_000_000_000, 1_200_000_000]
    assert (sequence.read(1).depth == 3000).all()
    assert "1 of 3 color images" in caplog.text


def test_depth_image_is_paired_with_one_color_image_only(tum_folder: Writer) -> None:
    sequence = open_sequence(str(tum_folder(["1.000", "1.012"], ["1.010"])))
    assert sequence.stamps_ns.tolist() == [1_012_000_000]


def test_lists_out_of_order_are_sorted_by_stamp(tum_folder: Writer) -> None:
    sequence = open_sequence(str(tum_folder(["2", "1", "3"], ["3", "2", "1"])))
    assert sequence.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    assert sequence.read(0).color[0, 0, 0] == 15
    assert [int(sequence.read(i).depth[0, 0]) for i in range(3)] == [3000, 2000, 1000]


def test_no_pair_at_all_is_a_data_error(tum_folder: Writer) -> None:
    with pytest.raises(DataError, match="none of the 1 color images is within 20 ms"):
        open_sequence(str(tum_folder(["1"], ["2"])))


def test_empty_lists_are_a_data_error(tum_folder: Writer) -> None:
    with pytest.raises(DataError, match="none of the 0 color"):
        open_sequence(str(tum_folder([], [])))


@pytest.mark.parametrize("line", ["1.5", "now rgb/1.png", "inf rgb/1.png"])
def test_unreadable_list_line_is_named(tum_folder: Writer, line: str) -> None:
    folder = tum_folder(["1"], ["1"])
    (folder / "rgb.txt").write_text(f"# x\n{line}\n")
    with pytest.raises(DataError, match=r"rgb\.txt, line 2"):
        open_sequence(str(folder))


@pytest.mark.parametrize("kept", [0, 10, 60, -13, -1])
@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_truncated_image_fails_alone(tum_folder: Writer, kind: str, kept: int) -> None:
    folder = tum_folder(["1", "2"], ["1", "2"])
    path = folder / kind / "1.png"
    path.write_bytes(path.read_bytes()[:kept])
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=r"1\.png is truncated"):
        sequence.read(0)
    assert sequence[1].index == 1


def test_corrupt_image_with_a_valid_end_is_an_error(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"])
    path = folder / "rgb/1.png"
    data = bytearray(path.read_bytes())
    data[12:-12] = bytes(len(data) - 24)
    path.write_bytes(data)
    with pytest.raises(FrameError, match="not a readable image"):
        open_sequence(str(folder)).read(0)


def test_missing_image_names_its_path(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"])
    (folder / "depth/1.png").unlink()
    with pytest.raises(FrameError, match=r"depth/1\.png cannot be read"):
        open_sequence(str(folder)).read(0)


def test_color_in_place_of_depth_is_an_error(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"])
    (folder / "depth/1.png").write_bytes((folder / "rgb/1.png").read_bytes())
    with pytest.raises(FrameError, match="one channel of 16 bits"):
        open_sequence(str(folder)).read(0)


def test_images_of_another_size_than_the_camera_fail(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"], size=(8, 12))
    with pytest.raises(FrameError, match=r"12x8.*24x16"):
        open_sequence(str(folder)).read(0)


def test_truth_is_optional(tum_folder: Writer) -> None:
    folder = tum_folder(["1"], ["1"])
    assert open_sequence(str(folder)).truth() is None
    (folder / "groundtruth.txt").write_text("# t\n0.99 1 2 3 0 0 0 1\n")
    truth = open_sequence(str(folder)).truth()
    assert truth is not None
    assert truth.T_world_camera[0, :3, 3].tolist() == [1, 2, 3]


def test_real_kitchen_reads(data: Path) -> None:
    sequence = open_sequence(str(data / "tum/kitchen"))
    assert sequence.camera == Camera(640, 480, 525, 525, 320, 238)
    frame = sequence[299]
    assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 4
    truth = sequence.truth()
    assert truth is not None
    assert len(truth) == len(sequence) == 600


def test_sequence_behind_a_link_has_the_name_of_the_link(
    tum_folder: Writer, tmp_path: Path
) -> None:
    link = tmp_path / "rgbd_dataset_freiburg1_linked"
    folder = tum_folder(["1"], ["1"])
    (folder / "camera.json").unlink()  # The published intrinsics are chosen by name.
    link.symlink_to(folder)
    assert open_sequence(str(link)).name == link.name


def test_calibration_txt_of_eth3d_is_for_the_size_of_the_images(tum_folder: Writer) -> None:
    folder = tum_folder(["1", "2"], ["1", "2"], None)
    (folder / "calibration.txt").write_text("20.5 21 11.25 7\n")
    (folder / "associated.txt").write_text("1 rgb/1.png 1 depth/1.png\n")
    sequence = open_sequence(str(folder))
    assert sequence.camera == Camera(24, 16, 20.5, 21.0, 11.25, 7.0)
    assert sequence[1].depth_m.max() == np.float32(0.4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("20 21 11", "the four numbers `fx fy cx cy`: not enough values"),
        ("20 21 11 y", "could not convert string to float: 'y'"),
        ("2000000 21 11 7", "focal length fx=2e[+]06 px is implausible"),
    ],
)
def test_broken_calibration_txt_is_named(tum_folder: Writer, text: str, message: str) -> None:
    folder = tum_folder(["1"], ["1"], None)
    (folder / "calibration.txt").write_text(text)
    with pytest.raises(DataError, match=f"calibration.txt.*{message}"):
        open_sequence(str(folder))


def test_intrinsics_of_bonn_are_known_by_the_name_of_the_folder(
    write_tum: Writer, tmp_path: Path
) -> None:
    folder = write_tum(tmp_path / "rgbd_bonn_crowd", ["1"], ["1"], None, (480, 640))
    camera = open_sequence(str(folder)).raw_camera
    assert (camera.fx, camera.cy, camera.distortion[0]) == (542.822841, 237.756098, 0.039903)


def test_intrinsics_of_bonn_are_those_beside_the_shared_part(data: Path) -> None:
    fields = json.loads((data / "tum/bonn_crowd_part/camera.json").read_text())
    del fields["depth_scale"]
    assert Camera.of(fields) == PUBLISHED_CAMERAS["rgbd_bonn"]
