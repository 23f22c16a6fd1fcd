import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera

from .recordings import small_frames, write_image, write_nerfstudio

FRAMES = small_frames(4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_nerfstudio(tmp_path / "desk", FRAMES)


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change the content of transforms.json, and return the folder."""
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_frames_of_equal_sizes_are_read_without_a_change(folder: Path) -> None:
    sequence = open_sequence(str(folder))
    assert sequence.name == "desk"
    assert sequence.camera == FRAMES[0].camera
    assert sequence.stamps_ns.tolist() == [0, 33333333, 66666666, 100000000]
    for k, expected in enumerate(FRAMES):
        raw = sequence.read(k)
        assert np.array_equal(raw.color, expected.color)
        assert np.array_equal(raw.depth, expected.depth)
        assert raw.depth_scale == expected.depth_scale
    assert sequence.truth() is None


def test_small_depth_is_enlarged(tmp_path: Path) -> None:
    sequence = open_sequence(str(write_nerfstudio(tmp_path / "a", FRAMES, (32, 24))))
    for frame, expected in zip(sequence, FRAMES, strict=True):
        error_m = np.abs(frame.depth_m - expected.depth_m())
        assert error_m[:, 1:-1].max() < 0.006


def test_order_is_that_of_the_file_and_frames_without_depth_are_skipped(folder: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["frames"].reverse()
        del content["frames"][1]["depth_file_path"]

    sequence = open_sequence(str(edit(folder, change)))
    found = [int(sequence.read(k).color[0, 0, 0]) for k in range(len(sequence))]
    assert found == [int(FRAMES[k].color[0, 0, 0]) for k in (3, 1, 0)]


def test_frame_has_its_own_intrinsics_and_those_of_all_frames_are_the_default(
    folder: Path,
) -> None:
    """Frame 0 defines the camera. The depth grows to the right, and frame 2 is shifted."""

    def change(content: dict[str, Any]) -> None:
        content["frames"][2]["cx"] = content["cx"] + 8

    sequence = open_sequence(str(edit(folder, change)))
    assert sequence.camera == FRAMES[0].camera
    found, depth = sequence.read(2).depth, FRAMES[2].depth
    assert np.array_equal(found[:, :56], depth[:, 8:])
    assert not found[:, 56:].any()
    assert np.array_equal(sequence.read(1).depth, FRAMES[1].depth)


def test_intrinsics_are_scaled_to_the_images_and_have_distortion(folder: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content.update(w=128, h=96, fl_x=110.0, cx=62.0, cy=50.0, k1=0.1, p2=0.02)
        del content["fl_y"]

    camera = open_sequence(str(edit(folder, change))).raw_camera
    assert camera == Camera(64, 48, 55.0, 55.0, 30.5, 24.5, (0.1, 0.0, 0.0, 0.02))


def test_size_of_the_images_is_the_default(folder: Path) -> None:
    edit(folder, lambda content: (content.pop("w"), content.pop("h"), content.update(k3=0.01)))
    camera = open_sequence(str(folder)).raw_camera
    assert (camera.width, camera.height) == (64, 48)
    assert camera.distortion == (0.0, 0.0, 0.0, 0.0, 0.01)


def test_damaged_image_is_one_bad_frame(folder: Path) -> None:
    path = folder / "depth/frame_00001.png"
    write_image(path, np.zeros((48, 64), np.uint8))
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=r"frame_00001\.png is uint8\(48, 64\), expected one chan"):
        sequence.read(1)
    assert sequence[2].index == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(frames=[]), 'expected a list "frames"'),
        (lambda c: c.update(frames=["a"]), 'expected a list "frames"'),
        (lambda c: [f.pop("depth_file_path") for f in c["frames"]], "again, with depth images"),
        (lambda c: c["frames"][1].update(file_path="../a.png"), r"'\.\./a\.png' is outside"),
        (lambda c: c["frames"][1].update(file_path="/a.png"), r"'/a\.png' is outside the folder"),
        (lambda c: c.pop("fl_x"), 'expected a finite number under "fl_x", but it is missing'),
        (lambda c: c.update(cx="1"), "expected a finite number under \"cx\", but it is '1'"),
        (lambda c: c["frames"][1].update(fl_y=0.5), r"fy=0\.5 px is implausible"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "camera_model is 'OPENCV_FISHEYE'"),
        (lambda c: c.update(k4=0.1), r"k4 is 0\.1"),
        (
            lambda c: c.update(h=64),
            "the images have 64x48 pixels, but the intrinsics are for 64x64",
        ),
        (lambda c: c.update(depth_unit_scale_factor=0), "is 0, must be positive"),
        (lambda c: c.update(depth_unit_scale_factor=5e-324), "the depth scale is inf"),
    ],
)
def test_invalid_content_is_named(
    folder: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        open_sequence(str(edit(folder, change)))
    assert "\n" not in str(caught.value)


def test_truncated_json_is_named(folder: Path) -> None:
    path = folder / "transforms.json"
    path.write_text(path.read_text()[:-10])
    with pytest.raises(DataError, match=r"transforms\.json cannot be read as JSON"):
        open_sequence(str(folder))


def test_depth_of_another_aspect_ratio_is_a_bad_frame(folder: Path) -> None:
    for path in (folder / "depths").glob("*.png") if (folder / "depths").is_dir() else []:
        write_image(path, np.ascontiguousarray(FRAMES[0].depth.T))
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        write_image(folder / frame["depth_file_path"], np.ascontiguousarray(FRAMES[0].depth.T))
    with pytest.raises(FrameError, match="aspect ratio"):
        open_sequence(str(folder)).read(0)


def test_missing_images_name_the_first_and_their_number(folder: Path) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        (folder / frame["file_path"]).unlink()
    with pytest.raises(DataError, match=r"none of 4 images can be read\. The error of the first: "):
        open_sequence(str(folder))
