"""Replays of the real actors, which give equal bytes or exit code 5."""

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
from ldo_service.runs.replayed import _caveats, _config_of, open_recording
from ldo_service.runtime.journal import StepRecord, checksum
from ldo_service.schemas import CameraRgbd, decode, encode
from ldo_service.testing import replay_recording
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.runs.conftest import FRAMES, record_service

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
    asyncio.run(record_service(tmp_path, room, count=8, prior=room.truth()))
    (tracker,) = replay_recording(tmp_path, "tracker").values()
    assert (tracker.taken["odometry/prior"], tracker.made["pose/tracked"]) == (8, 8)


def test_replay_does_not_depend_on_the_number_of_threads(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorded setting is "one thread per core", which depends on the machine."""
    cores = os.cpu_count() or 1
    monkeypatch.setattr(os, "cpu_count", lambda: cores + 2)
    replay_recording(recording, "mapper")


def test_flipped_bit_of_an_input_is_found_by_its_checksum(
    recording_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(recording_copy / "frame_source.mcap", flip_step=7)
    code, _, err = ldo(capsys, "replay", str(recording_copy), "--verify")
    assert code == 5
    error = err[err.index("ldo: ") :]
    assert_one_paragraph(error)
    assert "frame_source diverged at step 7 (frame_source.mcap, camera/rgbd #7)" in error
    assert len(set(re.findall(r"\b[0-9a-f]{8}\b", error))) == 2


def test_flipped_bit_with_fixed_checksum_changes_the_output(recording_copy: Path) -> None:
    """The checksum in the recording matches the changed frame."""
    rewrite(recording_copy / "frame_source.mcap", flip_step=7, fix_checksum=True)
    with pytest.raises(ReplayDiverged, match=r"step 7 .*output 1 of 1 differs: frame/rgbd"):
        replay_recording(recording_copy)


def rewrite(path: Path, flip_step: int, fix_checksum: bool = False) -> None:
    """Rewrite a recording file with one bit of the camera frame of one step flipped."""
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
            if topic == "camera/rgbd" and message.sequence == flip_step:
                body = flipped = encode(with_flipped_bit(decode(body, CameraRgbd)))
            if topic == "journal/step" and message.sequence == flip_step and fix_checksum:
                step = msgspec.msgpack.decode(body, type=StepRecord)
                fixed = msgspec.structs.replace(step, checksum=checksum(flipped))
                body = msgspec.msgpack.encode(fixed)
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "msgpack", 0)
            writer.add_message(
                channels[topic], message.log_time, body, message.publish_time, message.sequence
            )
        writer.finish()
    copy.rename(path)


def with_flipped_bit(frame: CameraRgbd) -> CameraRgbd:
    pixels = bytearray(frame.color.data)
    pixels[len(pixels) // 2] ^= 1
    color = msgspec.structs.replace(frame.color, data=memoryview(bytes(pixels)))
    return msgspec.structs.replace(frame, color=color)


# --- the command ----------------------------------------------------------------------------------
def test_replay_command_prints_counts_of_steps_and_messages(recording: Path, capsys) -> None:
    code, out, err = ldo(capsys, "replay", str(recording), "--verify", "--actor", "frame_source")
    assert code == 0
    assert re.search(r"frame_source .* 31 .* 30 camera/rgbd .* 30 frame/rgbd .* yes", out)
    assert "replay:" in err
    assert "note:" not in err


def test_divergence_without_verify_is_reported_with_exit_code_0(
    recording_copy: Path, capsys
) -> None:
    rewrite(recording_copy / "frame_source.mcap", flip_step=7)
    code, out, err = ldo(capsys, "replay", str(recording_copy), "--actor", "frame_source")
    assert code == 0
    assert "frame_source diverged at step 7" in err
    assert "until" in out
    assert "tracker" not in out


def test_replay_with_another_instruction_set_prints_a_note(
    recording: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded_with = kernels.isa()
    monkeypatch.setattr(kernels, "isa", lambda: "another")
    _, _, err = ldo(capsys, "replay", str(recording), "--actor", "frame_source")
    assert err.count(f"LDO_ISA={recorded_with}") == 1


def test_recording_with_another_gpu_has_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    gpu = {"gpu": "Some GPU", "triton": "3.7.1"}
    about = {"gpu": msgspec.json.encode(gpu).decode()}
    (note,) = _caveats(about)
    assert note.startswith("recorded with gpu Some GPU, triton 3.7.1, replayed with the CPU:")
    monkeypatch.setattr("ldo_service.runs.replayed.gpu_facts", lambda _: gpu)
    assert not _caveats(about)


def test_recording_without_a_gpu_has_a_note_if_the_replay_uses_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    facts = {"auto": {"gpu": "Some GPU"}, "cpu": {}}
    monkeypatch.setattr("ldo_service.runs.replayed.gpu_facts", facts.__getitem__)
    (note,) = _caveats({"gpu": "{}", "config": "service: {device: auto}"})
    assert note.startswith("recorded with the CPU, replayed with gpu Some GPU:")
    assert not _caveats({"gpu": "{}"})
    assert not _caveats({})  # A recording of an earlier version.


def test_earlier_recording_with_another_provider_is_refused_with_the_new_setting() -> None:
    with pytest.raises(ConfigError, match=r"inference.providers is now service.device"):
        _caveats({"config": "inference: {providers: [tensorrt, cpu], threads: 1}"})


@pytest.mark.parametrize(("providers", "device"), [("[cpu]", "cpu"), ("[cuda, cpu]", "cuda")])
def test_execution_providers_of_an_earlier_recording_select_the_device(
    providers: str, device: str
) -> None:
    config = _config_of({"config": f"inference: {{providers: {providers}, threads: 3}}"})
    assert (config.service.device, config.inference.threads) == (device, 3)


def test_damaged_facts_about_the_gpu_are_a_data_error() -> None:
    with pytest.raises(DataError, match="the entry gpu in the recording cannot be read"):
        _caveats({"gpu": "{"})


def test_an_unknown_actor_is_a_bad_argument(recording: Path, capsys) -> None:
    code, _, err = ldo(capsys, "replay", str(recording), "--actor", "trakcer")
    assert code == 2
    assert_one_paragraph(err)


def test_a_folder_without_a_recording_is_bad_data(tmp_path: Path, capsys) -> None:
    code, _, err = ldo(capsys, "replay", str(tmp_path))
    assert code == 3
    assert_one_paragraph(err)


def test_record_command_refuses_a_folder_with_other_files(tmp_path: Path, capsys) -> None:
    (tmp_path / "thesis.tex").touch()
    code, _, err = ldo(capsys, "record", str(tmp_path))
    assert code == 2
    assert_one_paragraph(err)
    assert "holds no recording" in err


# --- in pytest ------------------------------------------------------------------------------------
def test_a_recording_of_another_version_is_refused(
    recording: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "RECORDING_VERSION", 4)
    code, _, err = ldo(capsys, "replay", recording)
    assert code == DataError.exit_code
    assert_one_paragraph(err)
    assert "has recording version 3, but this service replays only version 4" in err


def test_selected_actors_are_opened_and_unknown_ones_refused(
    recording: Path, tmp_path: Path
) -> None:
    assert [actor.name for actor in open_recording(recording, ("tracker",))] == ["tracker"]
    with pytest.raises(ConfigError, match="no recording of actor 'nobody'"):
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


def test_example_has_one_test_case_per_actor(recording_copy: Path) -> None:
    rewrite(recording_copy / "frame_source.mcap", flip_step=7)
    done = pytest_on(EXAMPLE, recording_copy)
    assert f"1 failed, {len(GRAPH) - 1} passed" in done.stdout
    assert "ReplayDiverged: frame_source diverged at step 7" in done.stdout


def test_example_is_skipped_without_a_recording(tmp_path: Path) -> None:
    assert "1 skipped" in pytest_on(EXAMPLE, tmp_path).stdout
