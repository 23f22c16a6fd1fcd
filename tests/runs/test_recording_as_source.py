"""Recordings as sources of frames."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.recordings.mcap_file import RecordConfig, RecordingFile
from ldo_service.runs.recorded_sequence import RecordingSequence
from ldo_service.schemas import CameraColor, CameraDepth
from tests.commands.test_cli import ldo
from tests.runs.conftest import FRAMES, ROUGH


def test_frames_of_a_recording_equal_those_of_the_camera(recording: Path, room: Sequence) -> None:
    sequence = open_sequence(str(recording))
    assert len(sequence) == FRAMES
    assert sequence.raw_camera == room.raw_camera
    np.testing.assert_array_equal(sequence.stamps_ns, room.stamps_ns[:FRAMES])
    for index in (0, 17, FRAMES - 1):
        read, expected = sequence.read(index), room.read(index)
        np.testing.assert_array_equal(read.color, expected.color)
        np.testing.assert_array_equal(read.depth, expected.depth)
        assert (read.index, read.depth_scale) == (index, expected.depth_scale)


def test_run_over_a_recording_equals_the_run_over_its_source(
    recording: Path, tmp_path: Path, capsys
) -> None:
    options = ("--max-frames", "10", "--set", ROUGH)
    for source, out in ((str(recording), "recorded"), ("synthetic:room", "source")):
        code, _, err = ldo(capsys, "run", source, "--out", str(tmp_path / out), *options)
        assert code == 0, err
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "recorded" / name).read_bytes() == (
            tmp_path / "source" / name
        ).read_bytes()
    assert json.loads((tmp_path / "recorded" / "summary.json").read_text())["frames"] == 10


def test_frame_recorded_twice_is_read_once(recording_copy: Path) -> None:
    """The new process receives unhandled frames again after a crash."""
    (recording_copy / "frame_source.2.mcap").write_bytes(
        (recording_copy / "frame_source.mcap").read_bytes()
    )
    assert len(RecordingSequence(recording_copy)) == FRAMES


def test_damaged_frame_raises_a_frame_error(recording_copy: Path) -> None:
    path = recording_copy / "frame_source.mcap"
    content = bytearray(path.read_bytes())
    position = content.index(b"\xabdepth_scale", len(content) // 2)
    content[position : position + 3] = b"\xabXX"
    path.write_bytes(content)
    sequence = RecordingSequence(recording_copy)
    bad = []
    for index in range(FRAMES):
        try:
            sequence.read(index)
        except FrameError as error:
            bad.append(str(error))
    assert len(bad) == 1
    assert bad[0].startswith("frame 1")
    assert "frame_source.mcap cannot be decoded" in bad[0]


def test_damaged_first_frame_does_not_hide_the_others(recording_copy: Path) -> None:
    path = recording_copy / "frame_source.mcap"
    content = bytearray(path.read_bytes())
    position = content.index(b"\xabdepth_scale")
    content[position : position + 3] = b"\xabXX"
    path.write_bytes(content)
    sequence = RecordingSequence(recording_copy)
    assert sequence.camera == sequence.read(1).camera
    with pytest.raises(FrameError):
        sequence.read(0)


def test_a_recording_without_camera_is_bad_data(recording_copy: Path) -> None:
    (recording_copy / "frame_source.mcap").unlink()
    with pytest.raises(DataError, match="camera/rgbd"):
        open_sequence(str(recording_copy))


def test_sources_other_than_recordings_are_opened_or_refused(tmp_path: Path) -> None:
    assert open_sequence("synthetic:room").truth() is not None
    with pytest.raises(DataError, match="no known layout"):
        open_sequence(str(tmp_path))


def test_separate_color_and_depth_images_are_read_as_frames(room: Sequence, tmp_path: Path) -> None:
    """Color and depth have stamps 4 ms apart, and one color image has no depth."""
    file = RecordingFile(tmp_path / "frame_source.mcap", {}, RecordConfig())
    for index in range(4):
        frame = raw_frame_to_message(room.read(index))
        color = CameraColor(
            stamp_ns=frame.stamp_ns, frame=index, camera=frame.camera, image=frame.color
        )
        depth = CameraDepth(
            stamp_ns=frame.stamp_ns + 4_000_000,
            frame=index,
            camera=frame.camera,
            image=frame.depth,
            depth_scale=frame.depth_scale,
        )
        for topic, image in (("camera/color", color), ("camera/depth", depth)):
            if (topic, index) != ("camera/depth", 2):
                body = msgspec.msgpack.encode(image)
                file.add(topic, type(image), body, 2 * index, image.stamp_ns)
    file.close()
    sequence = open_sequence(str(tmp_path))
    np.testing.assert_array_equal(sequence.stamps_ns, room.stamps_ns[[0, 1, 3]])
    read, expected = sequence.read(2), room.read(3)
    assert read.index == 2
    np.testing.assert_array_equal(read.color, expected.color)
    np.testing.assert_array_equal(read.depth, expected.depth)
