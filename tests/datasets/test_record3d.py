import sys
from collections.abc import Callable
from pathlib import Path

import liblzfse
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DataError, FrameError

from .recordings import change_archive, small_frames, write_r3d

FRAMES = small_frames(11)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_r3d(tmp_path / "desk.r3d", FRAMES, (32, 24))


def test_frames_have_the_images_and_stamps_of_the_recording(path: Path) -> None:
    """Frame 10 comes after frame 9, although its name sorts before."""
    sequence = open_sequence(str(path))
    assert sequence.name == "desk"
    expected_ns = [frame.stamp_ns - FRAMES[0].stamp_ns for frame in FRAMES]
    assert sequence.stamps_ns.tolist() == expected_ns
    for frame, expected in zip(sequence, FRAMES, strict=True):
        assert np.max(np.abs(frame.color.astype(int) - expected.color)) <= 2  # JPEG
        error_m = np.abs(frame.depth_m - expected.depth_m())
        assert error_m[:, 1:-1].max() < 0.006
    assert sequence.camera == FRAMES[0].camera
    assert sequence.truth() is None


def test_matrix_is_read_by_columns_and_scaled_to_the_images(tmp_path: Path) -> None:
    K = [40.0, 0, 0, 0, 41.0, 0, 15.0, 11.0, 1]
    path = write_r3d(tmp_path / "a.r3d", FRAMES, (32, 24), K=K, w=32, h=24)
    camera = open_sequence(str(path)).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (80.0, 82.0, 30.5, 22.5)


def test_each_frame_has_its_own_intrinsics(tmp_path: Path) -> None:
    """The first frame defines the camera; frame 1 has a shifted principal point."""
    frames = small_frames(2)
    ramp = np.arange(64, dtype=np.uint8)[None, :, None] * 3 + np.zeros((48, 1, 3), np.uint8)
    frames = [
        frame.__class__(k, k, ramp, frame.depth, 1000.0, frame.camera)
        for k, frame in enumerate(frames)
    ]
    first = [51.2, 38.4, 31.5, 23.5]
    coefficients = [first, [51.2, 38.4, 41.5, 23.5]]
    path = write_r3d(
        tmp_path / "a.r3d", frames, perFrameIntrinsicCoeffs=coefficients, frameTimestamps=None
    )
    sequence = open_sequence(str(path))
    assert [sequence.camera.cx, sequence.camera.fx] == [31.5, 51.2]
    shifted, plain = sequence[1], sequence[0]
    assert np.max(np.abs(plain.color.astype(int)[:, :54] + 30 - shifted.color[:, :54])) <= 4
    assert np.all(shifted.color[:, 54:] == 0)
    assert np.all(shifted.depth_m[:, 54:] == 0)
    assert sequence.stamps_ns.tolist() == [0, 33333333]


def test_depth_of_low_confidence_is_dropped_and_confidence_is_optional(path: Path) -> None:
    low = liblzfse.compress(np.ones((24, 32), np.uint8).tobytes())
    change_archive(path, {"rgbd/1.conf": low, "rgbd/2.conf": None})
    sequence = open_sequence(str(path))
    assert not sequence[1].depth_m.any()
    assert sequence[2].depth_m.all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "rgbd/1.depth",
            b"bvx2 and no more",
            r"rgbd/1\.depth is damaged, or it is not an image of 32x24",
        ),
        ("rgbd/1.depth", b"", r"rgbd/1\.depth is damaged"),
        ("rgbd/1.depth", liblzfse.compress(bytes(24 * 32)), r"32x24 pixels of type float32"),
        ("rgbd/1.depth", b"bvx-\xff\xff\xff\xff" + bytes(99), r"rgbd/1\.depth is damaged"),
        ("rgbd/1.conf", liblzfse.compress(bytes(24)), r"rgbd/1\.conf is damaged"),
        ("rgbd/1.jpg", b"\xff\xd8\xff short", r"desk\.r3d: rgbd/1\.jpg is truncated"),
    ],
)
def test_damaged_image_is_one_bad_frame(
    path: Path, name: str, content: bytes, message: str
) -> None:
    change_archive(path, {name: content})
    sequence = open_sequence(str(path))
    with pytest.raises(FrameError, match=message):
        sequence.read(1)
    assert sequence[2].index == 2


def test_damaged_first_color_image_does_not_hide_the_size_of_the_others(path: Path) -> None:
    change_archive(path, {"rgbd/0.jpg": b""})
    assert open_sequence(str(path))[1].camera == FRAMES[0].camera


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_cut, r"desk\.r3d cannot be read as a recording of Record3D, a ZIP archive"),
        (lambda path: path.write_bytes(b""), "a ZIP archive with a file `metadata`"),
        (lambda path: change_archive(path, {"metadata": None}), "KeyError"),
        (lambda path: change_archive(path, {"metadata": b"{"}), "JSONDecodeError"),
        (lambda path: change_archive(path, {"metadata": b"[1]"}), "`metadata` contains a list"),
        (
            lambda path: change_archive(path, {f"rgbd/{k}.depth": None for k in range(11)}),
            r"no pair of files rgbd/N",
        ),
    ],
)
def test_damaged_archive_is_named(path: Path, damage: Callable[[Path], None], message: str) -> None:
    damage(path)
    with pytest.raises(DataError, match=message) as caught:
        open_sequence(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"K": None}, "K of the metadata is missing"),
        ({"K": [1.0, 2.0]}, "K of the metadata is missing or has a wrong length"),
        ({"K": [1.0, 0, 0, 0, 1, 0, 0, 0, 1]}, "focal length fx=1 px is implausible"),
        ({"perFrameIntrinsicCoeffs": [[50, 50, 30]]}, r"perFrameIntrinsicCoeffs\[0\] of the meta"),
        ({"dw": None}, 'expected a finite number under "dw"'),
        ({"dh": 1e9}, r"dh of the metadata is 1e\+09, expected a whole number of pixels"),
        ({"h": 64}, r"the images have 64x48 pixels, but the intrinsics are for 64x64"),
        ({"frameTimestamps": [0.0, 0.1, 0.1]}, "the metadata need frameTimestamps"),
        ({"frameTimestamps": None, "fps": 0}, "fps must be a positive number"),
        ({"frameTimestamps": "abcdefghijkl"}, "the metadata need frameTimestamps"),
    ],
)
def test_invalid_metadata_is_named(
    tmp_path: Path, metadata: dict[str, object], message: str
) -> None:
    path = write_r3d(tmp_path / "a.r3d", FRAMES, (32, 24), **metadata)
    with pytest.raises(DataError, match=message):
        open_sequence(str(path))


def test_missing_library_is_an_error_with_install_command(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(ConfigError, match=r"desk\.r3d .*extra `phones`.*'\.\[phones\]'"):
        open_sequence(str(path))
