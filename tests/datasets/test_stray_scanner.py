import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.datasets.video import Video
from ldo_service.errors import ConfigError, DataError, FrameError

from .recordings import small_frames, write_image, write_stray, write_video

FRAMES = small_frames(12)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_stray(tmp_path / "71de12f9", FRAMES, (32, 24), gop=4)


def test_frames_have_the_images_and_stamps_of_the_recording(folder: Path) -> None:
    sequence = open_sequence(str(folder))
    assert sequence.name == "71de12f9"
    assert sequence.stamps_ns.tolist() == [frame.stamp_ns for frame in FRAMES]
    for frame, expected in zip(sequence, FRAMES, strict=True):
        assert np.max(np.abs(frame.color.astype(int) - expected.color)) <= 3  # H.264
        is_seen = frame.depth_m > 0
        assert is_seen[4:-4, 4:-4].all()
        error_m = np.abs(frame.depth_m - expected.depth_m())[is_seen]
        assert error_m.max() < 0.006
    assert sequence.camera == FRAMES[0].camera
    assert sequence.truth() is None


def test_large_video_is_averaged_and_its_intrinsics_follow(tmp_path: Path) -> None:
    frames = small_frames(2, 640, 480)
    sequence = open_sequence(str(write_stray(tmp_path / "a", frames, enlarged=2)))
    camera, expected = sequence.camera, frames[0].camera
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(camera.matrix, expected.matrix, rtol=1e-12)


def test_frames_in_any_order_are_those_in_order(folder: Path) -> None:
    video = Video(folder / "rgb.mp4")
    in_order = [video.read(k) for k in range(12)]
    for k in (11, 3, 4, 4, 0, 9, 1, 2, 7):
        assert np.array_equal(video.read(k), in_order[k])


def test_frames_in_order_are_decoded_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video, sought = Video(folder / "rgb.mp4"), []
    monkeypatch.setattr(
        video, "_seek", lambda index, seek=video._seek: (sought.append(index), seek(index))
    )
    for k in range(12):
        video.read(k)
    assert sought == [0]
    for k in (0, 5, 6, 7):
        video.read(k)
    assert len(sought) == 3


def test_depth_of_low_confidence_is_dropped(folder: Path) -> None:
    confidence = np.full((24, 32), 2, np.uint8)
    confidence[:, :16] = 1
    write_image(folder / "confidence/000003.png", confidence)
    sequence = open_sequence(str(folder))
    assert np.all(sequence[3].depth_m[:, :32] == 0)
    assert np.all(sequence[3].depth_m[:, 34:] > 0)
    assert np.all(sequence[4].depth_m > 0)


def test_frames_without_depth_or_stamp_are_skipped(folder: Path) -> None:
    (folder / "depth/000002.png").unlink()
    lines = (folder / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join(lines[:6] + lines[7:]))
    sequence = open_sequence(str(folder))
    known = [k for k in range(12) if k not in (2, 5)]
    assert sequence.stamps_ns.tolist() == [FRAMES[k].stamp_ns for k in known]
    assert abs(int(sequence[2].color[24, 32, 0]) - int(FRAMES[3].color[0, 0, 0])) <= 3


def test_damaged_depth_is_one_bad_frame(folder: Path) -> None:
    path = folder / "depth/000003.png"
    path.write_bytes(path.read_bytes()[:-20])
    sequence = open_sequence(str(folder))
    with pytest.raises(FrameError, match=r"000003\.png is truncated"):
        sequence.read(3)
    assert sequence[4].index == 4


def test_damaged_part_of_the_video_costs_only_its_frames(tmp_path: Path) -> None:
    """The header of a slice is overwritten; the other groups of pictures are still whole."""
    rng = np.random.default_rng(2)
    images = [rng.integers(0, 255, (48, 64, 3), np.uint8) for _ in range(12)]
    path = tmp_path / "rgb.mp4"
    write_video(path, images, gop=4)
    whole = Video(path)
    expected = [whole.read(k) for k in range(12)]
    data = bytearray(path.read_bytes())
    middle = data.index(b"mdat") + (data.index(b"moov") - data.index(b"mdat")) // 2
    data[middle : middle + 400] = bytes([0xFF]) * 400
    path.write_bytes(data)
    video, bad = Video(path), []
    for k in range(12):
        with suppress(FrameError):
            if np.array_equal(video.read(k), expected[k]):
                continue
        bad.append(k)
    assert 0 < len(bad) <= 5
    assert {0, 11}.isdisjoint(bad)


def _cut(name: str, size: int) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size]) and None


def _text(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_cut("rgb.mp4", 900), r"rgb\.mp4 cannot be read as a video.*truncated"),
        (_cut("rgb.mp4", 0), r"rgb\.mp4 cannot be read as a video"),
        (lambda f: (f / "odometry.csv").unlink(), r"odometry\.csv cannot be read"),
        (_text("odometry.csv", "t, f\n1.0, 0\n1.0, 1\n"), r"line 3: frame 1 at 1\.0 s must be lat"),
        (_text("odometry.csv", "t, f\n1.0, 0\nnow, 1\n"), r"line 3: expected `timestamp, frame"),
        (_text("odometry.csv", "t, f\n"), "12 color images, 12 depth images and 0 lines"),
        (_text("camera_matrix.csv", "1,2\n3,4\n"), r"has the shape \(2, 2\), expected 3 rows"),
        (_text("camera_matrix.csv", "1,2\n3\n"), r"camera_matrix\.csv cannot be read as a matrix"),
        (
            _text("camera_matrix.csv", "1,0,2\n0,1,2\n0,0,1\n"),
            "focal length fx=1 px is implausible",
        ),
    ],
)
def test_missing_or_damaged_file_is_named(
    folder: Path, damage: Callable[[Path], None], message: str
) -> None:
    damage(folder)
    with pytest.raises(DataError, match=message) as caught:
        open_sequence(str(folder))
    assert "\n" not in str(caught.value)


def test_missing_library_is_an_error_with_install_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"rgb\.mp4 .*extra `phones`.*'\.\[phones\]'"):
        open_sequence(str(folder))
