"""A recording is a data set."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.recordings.mcap_file import RecordConfig, RecordingFile
from ldo_service.runs.source import RecordingSequence, open_source
from ldo_service.schemas import CameraColor, CameraDepth
from tests.commands.test_cli import ldo
from tests.runs.conftest import FRAMES, ROUGH


def test_the_frames_are_those_of_the_camera(recording: Path, room: Sequence) -> None:
    sequence = open_source(str(recording))
    assert len(sequence) == FRAMES
    assert sequence.raw_camera == room.raw_camera
    np.testing.assert_array_equal(sequence.stamps_ns, room.stamps_ns[:FRAMES])
    for index in (0, 17, FRAMES - 1):
        ours, theirs = sequence.read(index), room.read(index)
        np.testing.assert_array_equal(ours.color, theirs.color)
        np.testing.assert_array_equal(ours.depth, theirs.depth)
        assert (ours.index, ours.depth_scale) == (index, theirs.depth_scale)


def test_a_run_over_it_is_a_run_over_its_source(recording: Path, tmp_path: Path, capsys) -> None:
    options = ("--max-frames", "10", "--set", ROUGH)
    for source, out in ((str(recording), "recorded"), ("synthetic:room", "source")):
        code, _, err = ldo(capsys, "run", source, "--out", str(tmp_path / out), *options)
        assert code == 0, err
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "recorded" / name).read_bytes() == (
            tmp_path / "source" / name
        ).read_bytes()
    assert json.loads((tmp_path / "recorded" / "summary.json").read_text())["frames"] == 10


def test_a_frame_that_was_taken_twice_is_one_frame(spoilt: Path) -> None:
    """As after a crash: the new life takes again what the old one had not handled."""
    (spoilt / "frame_source.2.mcap").write_bytes((spoilt / "frame_source.mcap").read_bytes())
    assert len(RecordingSequence(spoilt)) == FRAMES


def test_a_damaged_frame_is_a_bad_frame(spoilt: Path) -> None:
    path = spoilt / "frame_source.mcap"
    content = bytearray(path.read_bytes())
    place = content.index(b"\xabdepth_scale", len(content) // 2)
    content[place : place + 3] = b"\xabXX"
    path.write_bytes(content)
    sequence = RecordingSequence(spoilt)
    bad = []
    for index in range(FRAMES):
        try:
            sequence.read(index)
        except FrameError as error:
            bad.append(str(error))
    assert len(bad) == 1
    assert "frame_source.mcap, frame 1" in bad[0]


def test_a_first_frame_that_is_damaged_hides_no_other(spoilt: Path) -> None:
    path = spoilt / "frame_source.mcap"
    content = bytearray(path.read_bytes())
    place = content.index(b"\xabdepth_scale")
    content[place : place + 3] = b"\xabXX"
    path.write_bytes(content)
    sequence = RecordingSequence(spoilt)
    assert sequence.camera == sequence.read(1).camera
    with pytest.raises(FrameError):
        sequence.read(0)


def test_a_recording_without_camera_is_bad_data(spoilt: Path) -> None:
    (spoilt / "frame_source.mcap").unlink()
    with pytest.raises(DataError, match="camera/rgbd"):
        open_source(str(spoilt))


def test_other_sources_are_opened_as_before(tmp_path: Path) -> None:
    assert open_source("synthetic:room").truth() is not None
    with pytest.raises(DataError, match="no known layout"):
        open_source(str(tmp_path))


def test_halves_are_frames_too(room: Sequence, tmp_path: Path) -> None:
    """Of a camera that sends colour and depth apart, 4 ms off, and one colour without depth."""
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
        for topic, half in (("camera/color", color), ("camera/depth", depth)):
            if (topic, index) != ("camera/depth", 2):
                body = msgspec.msgpack.encode(half)
                file.add(topic, type(half), body, 2 * index, half.stamp_ns)
    file.close()
    sequence = open_source(str(tmp_path))
    np.testing.assert_array_equal(sequence.stamps_ns, room.stamps_ns[[0, 1, 3]])
    ours, theirs = sequence.read(2), room.read(3)
    assert ours.index == 2
    np.testing.assert_array_equal(ours.color, theirs.color)
    np.testing.assert_array_equal(ours.depth, theirs.depth)
