import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import SequenceOptions, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import se3

from .recordings import small_frames, write_sens

FRAMES = small_frames(4)
CAMERA = FRAMES[0].camera
# Positions in the header, for a name of 15 bytes.
MATRICES, FORMAT = 27, 27 + 256
FIRST_FRAME = FORMAT + 36
DEPTH_BYTES = 64 * 48 * 2


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_sens(tmp_path / "scene0000_00.sens", FRAMES, "")


def put(path: Path, offset: int, kind: str, *values: float) -> Path:
    """Overwrite numbers in a file."""
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + kind, data, offset, *values)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("suffix", ["", ".png"])
def test_frames_are_those_of_the_file(tmp_path: Path, suffix: str, zipped: bool) -> None:
    sequence = open_sequence(str(write_sens(tmp_path / "a.sens", FRAMES, suffix, zipped)))
    assert sequence.name == "a"
    assert sequence.stamps_ns.tolist() == [frame.stamp_ns for frame in FRAMES]
    np.testing.assert_allclose(sequence.camera.matrix, CAMERA.matrix, rtol=1e-7)
    for k, expected in enumerate(FRAMES):
        raw = sequence.read(k)
        assert np.array_equal(raw.color, expected.color)
        assert np.array_equal(raw.depth, expected.depth)
        assert raw.depth_scale == 1000.0


def test_color_may_be_jpeg(tmp_path: Path) -> None:
    raw = open_sequence(str(write_sens(tmp_path / "a.sens", FRAMES, ".jpg"))).read(2)
    assert np.max(np.abs(raw.color.astype(int) - FRAMES[2].color)) <= 2


def test_frame_without_a_valid_pose_has_no_truth(path: Path) -> None:
    truth = open_sequence(str(path)).truth()
    assert truth is not None
    assert truth.T_world_camera[:, 0, 3].tolist() == [0, 2, 3]
    np.testing.assert_allclose(truth.stamps_s, [FRAMES[k].stamp_ns / 1e9 for k in (0, 2, 3)])


def test_depth_of_a_separate_camera_is_registered_to_color(tmp_path: Path) -> None:
    """A wall at 2 m moves by 51.2 * 0.1 / 2 = 2.6 pixels for 0.1 m between the cameras."""
    T = se3.exp(np.array([0, 0, 0, 0.1, 0, 0]))
    frames = [
        frame.__class__(
            frame.index, frame.stamp_ns, frame.color, np.full((48, 64), 2000, np.uint16), 1000.0,
            CAMERA,
        )
        for frame in FRAMES
    ]  # fmt: skip
    sequence = open_sequence(str(write_sens(tmp_path / "a.sens", frames, "", True, T)))
    depth_m = sequence[1].depth_m
    assert np.all(depth_m[:, :2] == 0)
    assert np.all(depth_m[:, 3:] == 2.0)
    truth = sequence.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera[:, 0, 3], [-0.1, 1.9, 2.9], atol=1e-6)


def test_depth_is_registered_on_request(path: Path) -> None:
    sequence = open_sequence(str(path), SequenceOptions(register_depth=True))
    raw = sequence.read(2)
    assert raw.depth.dtype == np.float32
    np.testing.assert_allclose(raw.depth, FRAMES[2].depth_m(), atol=0.006)


def test_stamps_that_do_not_ascend_are_replaced(path: Path) -> None:
    put(path, FIRST_FRAME + 64, "Q", 2**62)
    assert open_sequence(str(path)).stamps_ns.tolist() == [0, 33333333, 66666666, 100000000]


def test_damaged_depth_is_one_bad_frame(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens", FRAMES, "")
    data, compressed = path.read_bytes(), zlib.compress(FRAMES[1].depth.tobytes())
    path.write_bytes(data.replace(compressed, bytes(len(compressed))))
    sequence = open_sequence(str(path))
    with pytest.raises(FrameError, match=r"a\.sens, frame 1, depth cannot be decompressed"):
        sequence.read(1)
    longer = zlib.compress(bytes(DEPTH_BYTES + 2))
    path.write_bytes(data.replace(compressed, longer + bytes(len(compressed) - len(longer))))
    with pytest.raises(FrameError, match=f"frame 1, depth does not have the {DEPTH_BYTES} bytes"):
        open_sequence(str(path)).read(1)
    assert sequence[2].index == 2


def test_damaged_color_is_one_bad_frame(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "a.sens", FRAMES, ".png")
    first = path.read_bytes().index(b"\x89PNG")
    sequence = open_sequence(str(put(path, first + 16, "I", 7)))
    with pytest.raises(FrameError, match=r"a\.sens, frame 0, color"):
        sequence.read(0)
    assert sequence[1].index == 1


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(b""), "is truncated in its header"),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "is truncated in its header"),
        (lambda path: path.write_bytes(path.read_bytes()[:-5000]), "truncated in frame 3 of 4"),
        (lambda path: put(path, 0, "I", 3), r"not a \.sens file of version 4: its version is 3"),
        (lambda path: put(path, 4, "Q", 2**60), "sensor name has 1152921504606846976 bytes"),
        (lambda path: put(path, FORMAT, "i", -1), "color of compression -1"),
        (lambda path: put(path, FORMAT + 4, "i", 2), "depth of compression 2"),
        (lambda path: put(path, FORMAT + 8, "I", 2**31), "more than the maximum"),
        (lambda path: put(path, FORMAT + 24, "f", 0.0), r"the depth scale is 0\.0"),
        (lambda path: put(path, FORMAT + 28, "Q", 0), "header announces 0 frames"),
        (lambda path: put(path, FORMAT + 28, "Q", 2**63), "bytes can have 1 to [0-9]+ frames"),
        (lambda path: put(path, FORMAT + 28, "Q", 5), "truncated in frame 4 of 5"),
        (lambda path: put(path, MATRICES, "f", np.nan), "contain NaN or infinity"),
        (lambda path: put(path, MATRICES + 64, "f", 3.0), "the extrinsics of color"),
        (lambda path: put(path, FIRST_FRAME + 80, "Q", 2**63), "truncated in frame 0 of 4"),
    ],
)
def test_invalid_file_is_named(path: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(path)
    with pytest.raises(DataError, match=f"scene0000_00.sens.*{message}") as caught:
        open_sequence(str(path))
    assert "\n" not in str(caught.value)


def test_registration_is_that_of_the_reader_only_on_request(path: Path) -> None:
    assert open_sequence(str(path)).registration == "source"
    registered = open_sequence(str(path), SequenceOptions(register_depth=True))
    assert registered.registration == "reader"
