"""The real actors, replayed: the same bytes, or exit code 5."""

import asyncio
import os
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from ldo_service import kernels
from ldo_service.actors.topology import GRAPH
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError, ReplayDiverged
from ldo_service.recordings import mcap_file
from ldo_service.runs.replayed import open_recording
from ldo_service.runtime.journal import StepRecord, checksum
from ldo_service.schemas import CameraRgbd, decode, encode
from ldo_service.testing import replay_recording
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.runs.conftest import FRAMES, live

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "replay_test.py"


def test_every_actor_replays(recording: Path) -> None:
    replayed = replay_recording(recording)
    assert set(replayed) == {box.name for box in GRAPH}
    assert replayed["frame_source"].steps == FRAMES + 1
    assert replayed["tracker"].made["pose/tracked"] >= FRAMES - 1
    keyframes = replayed["tracker"].made["keyframe/new"]
    assert keyframes > 2
    assert replayed["mapper"].taken["keyframe/new"] == keyframes
    refinements = replayed["mapper"].made["keyframe/refinement"]
    assert refinements > 0
    assert replayed["optimizer"].made["graph/correction"] == keyframes + refinements


def test_a_tracker_with_a_prior_replays(room: Sequence, tmp_path: Path) -> None:
    asyncio.run(live(tmp_path, room, count=8, prior=room.truth()))
    (tracker,) = replay_recording(tmp_path, "tracker").values()
    assert (tracker.taken["odometry/prior"], tracker.made["pose/tracked"]) == (8, 8)


@pytest.mark.parametrize("threads", [1, 3])
def test_the_number_of_threads_is_no_input(
    recording: Path, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """The configuration says "all cores but one", whatever machine it is."""
    monkeypatch.setattr(os, "cpu_count", lambda: threads + 1)
    replay_recording(recording, "mapper")


def test_one_bit_of_a_frame_is_found(spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(spoilt / "frame_source.mcap", flip_a_pixel_of=7)
    code, _, err = ldo(capsys, "replay", str(spoilt), "--verify")
    assert code == 5
    error = err[err.index("ldo: ") :]
    assert_one_paragraph(error)
    assert "frame_source diverged at step 7 (frame_source.mcap, camera/rgbd #7)" in error
    assert len(set(re.findall(r"\b[0-9a-f]{8}\b", error))) == 2


def test_one_bit_changes_what_the_actor_makes(spoilt: Path) -> None:
    """The same, where whoever changed the frame also changed its checksum."""
    rewrite(spoilt / "frame_source.mcap", flip_a_pixel_of=7, mend_checksum=True)
    with pytest.raises(ReplayDiverged, match=r"step 7 .*output 1 of 1 differs: frame/rgbd"):
        replay_recording(spoilt)


def rewrite(path: Path, flip_a_pixel_of: int, mend_checksum: bool = False) -> None:
    """Copy with the MCAP library, one bit of one decoded frame flipped."""
    copy = path.with_suffix(".new")
    flipped = b""
    with path.open("rb") as source, copy.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start()
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages():
            body, topic = message.data, channel.topic
            if topic == "camera/rgbd" and message.sequence == flip_a_pixel_of:
                body = flipped = encode(with_a_flipped_bit(decode(body, CameraRgbd)))
            if topic == "journal/step" and message.sequence == flip_a_pixel_of and mend_checksum:
                step = msgspec.msgpack.decode(body, type=StepRecord)
                mended = msgspec.structs.replace(step, checksum=checksum(flipped))
                body = msgspec.msgpack.encode(mended)
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "msgpack", 0)
            writer.add_message(
                channels[topic], message.log_time, body, message.publish_time, message.sequence
            )
        writer.finish()
    copy.rename(path)


def with_a_flipped_bit(frame: CameraRgbd) -> CameraRgbd:
    pixels = bytearray(frame.color.data)
    pixels[len(pixels) // 2] ^= 1
    color = msgspec.structs.replace(frame.color, data=memoryview(bytes(pixels)))
    return msgspec.structs.replace(frame, color=color)


# --- the command ----------------------------------------------------------------------------------
def test_the_command_counts_what_was_replayed(recording: Path, capsys) -> None:
    code, out, err = ldo(capsys, "replay", str(recording), "--verify")
    assert code == 0
    assert re.search(r"frame_source .* 31 .* 30 camera/rgbd .* 30 frame/rgbd .* yes", out)
    assert "replay:" in err
    assert "note:" not in err


def test_without_verify_a_difference_is_told_and_no_error(spoilt: Path, capsys) -> None:
    rewrite(spoilt / "frame_source.mcap", flip_a_pixel_of=7)
    code, out, err = ldo(capsys, "replay", str(spoilt), "--actor", "frame_source")
    assert code == 0
    assert "frame_source diverged at step 7" in err
    assert "until" in out
    assert "tracker" not in out


def test_another_instruction_set_is_noted(
    recording: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded_with = kernels.isa()
    monkeypatch.setattr(kernels, "isa", lambda: "another")
    _, _, err = ldo(capsys, "replay", str(recording), "--actor", "frame_source")
    assert err.count(f"LDO_ISA={recorded_with}") == 1


def test_an_unknown_actor_is_a_bad_argument(recording: Path, capsys) -> None:
    code, _, err = ldo(capsys, "replay", str(recording), "--actor", "trakcer")
    assert code == 2
    assert_one_paragraph(err)


def test_a_folder_without_a_recording_is_bad_data(tmp_path: Path, capsys) -> None:
    code, _, err = ldo(capsys, "replay", str(tmp_path))
    assert code == 3
    assert_one_paragraph(err)


def test_a_recording_is_never_written_over(recording: Path, capsys) -> None:
    code, _, err = ldo(capsys, "record", str(recording))
    assert code == 2
    assert_one_paragraph(err)


# --- as a test ------------------------------------------------------------------------------------
def test_a_recording_of_another_version_is_refused(
    recording: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "RECORDING_VERSION", 3)
    code, _, err = ldo(capsys, "replay", recording)
    assert code == DataError.exit_code
    assert_one_paragraph(err)
    assert "has version=2, and this service replays 3" in err


def test_only_some_actors_may_be_opened(recording: Path, tmp_path: Path) -> None:
    assert [actor.name for actor in open_recording(recording, ("tracker",))] == ["tracker"]
    with pytest.raises(ConfigError, match="no actor 'nobody'"):
        open_recording(recording, ("nobody",))
    with pytest.raises(DataError, match="ldo record"):
        open_recording(tmp_path)


def pytest_on(example: Path, recording: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(example)],
        env={**os.environ, "LDO_RECORDING": str(recording)},
        capture_output=True,
        text=True,
    )


def test_the_example_makes_a_case_of_each_actor(spoilt: Path) -> None:
    rewrite(spoilt / "frame_source.mcap", flip_a_pixel_of=7)
    done = pytest_on(EXAMPLE, spoilt)
    assert f"1 failed, {len(GRAPH) - 1} passed" in done.stdout
    assert "ReplayDiverged: frame_source diverged at step 7" in done.stdout


def test_the_example_skips_where_nothing_is_recorded(tmp_path: Path) -> None:
    assert "1 skipped" in pytest_on(EXAMPLE, tmp_path).stdout
