import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import SequenceOptions, open_sequence
from ldo_service.datasets.open3d import REDWOOD_CAMERA
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import RawFrame

from .recordings import small_frames, write_image, write_open3d

FRAMES = small_frames(3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_open3d(tmp_path / "desk", FRAMES)


@pytest.mark.parametrize(
    ("name", "intrinsics"),
    [("{:06d}", "camera_intrinsic.json"), ("{:07d}-000000033333", "intrinsic.json")],
)
def test_frames_are_those_of_the_folder(tmp_path: Path, name: str, intrinsics: str) -> None:
    sequence = open_sequence(str(write_open3d(tmp_path / "desk", FRAMES, name, intrinsics)))
    assert (sequence.name, sequence.raw_camera) == ("desk", FRAMES[0].camera)
    assert sequence.stamps_ns.tolist() == [0, 33333333, 66666666]
    for k, expected in enumerate(FRAMES):
        raw = sequence.read(k)
        assert np.array_equal(raw.color, expected.color)
        assert np.array_equal(raw.depth, expected.depth)
        assert raw.depth_scale == 1000.0
    assert sequence.truth() is None


@pytest.mark.parametrize("name", ["image", "rgb"])
def test_redwood_may_name_the_color_folder_otherwise(folder: Path, name: str) -> None:
    (folder / "color").rename(folder / name)
    sequence = open_sequence(str(folder))
    assert np.array_equal(sequence.read(2).color, FRAMES[2].color)


@pytest.mark.parametrize(
    ("color", "name"), [("image", "{:06d}"), ("rgb", "{:07d}-000000033333"), ("rgb", "{:06d}")]
)
def test_redwood_without_intrinsics_has_those_of_a_primesense(
    tmp_path: Path, color: str, name: str
) -> None:
    frame = RawFrame(
        0, 0, np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.uint16), 1e3, REDWOOD_CAMERA
    )
    folder = write_open3d(tmp_path / "redwood", [frame], name)
    (folder / "intrinsic.json").unlink()
    (folder / "color").rename(folder / color)
    if (color, name) == ("rgb", "{:06d}"):  # Many programs write such folders.
        with pytest.raises(DataError, match="no known layout"):
            open_sequence(str(folder))
        return
    assert open_sequence(str(folder)).raw_camera == REDWOOD_CAMERA


def test_images_of_another_size_need_intrinsics(folder: Path) -> None:
    (folder / "intrinsic.json").unlink()
    (folder / "color").rename(folder / "image")
    with pytest.raises(DataError, match=r"have 64x48 pixels, not 640x480.*camera_intrinsic\.json"):
        open_sequence(str(folder))


def test_image_of_another_size_is_one_bad_frame(folder: Path) -> None:
    write_image(folder / "depth/000001.png", np.zeros((24, 32), np.uint16))
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match="color is 64x48 and depth 32x24 pixels"):
        sequence.read(1)
    assert sequence[2].index == 2


def _set(key: str, value: object) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        path = folder / "intrinsic.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_set("intrinsic_matrix", [1, 2]), 'expected a list of 9 numbers under "intrinsic_matrix"'),
        (_set("intrinsic_matrix", ["a"] * 9), "expected a finite number under \"fx\".*it is 'a'"),
        (_set("width", None), 'expected a finite number under "width"'),
        (_set("height", 4800), "focal length fy=51.2 px is implausible"),
        (lambda f: (f / "intrinsic.json").write_text("{"), "cannot be read as JSON"),
    ],
)
def test_invalid_intrinsics_are_named(
    folder: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(folder)
    with pytest.raises(DataError, match=f"/intrinsic.json.*{message}"):
        open_sequence(str(folder))


def test_folder_without_depth_is_named(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        path.unlink()
    with pytest.raises(DataError, match="has 3 color and 0 depth images"):
        open_sequence(str(folder))


def test_registration_is_rejected_because_depth_is_registered(folder: Path) -> None:
    with pytest.raises(ConfigError, match="registered to color already"):
        open_sequence(str(folder), SequenceOptions(register_depth=True))
