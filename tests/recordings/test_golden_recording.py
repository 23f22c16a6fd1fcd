"""Tests of recordings of earlier versions; `golden` has one for each version that can be read."""

import tarfile
from pathlib import Path

import pytest

from ldo_service.recordings.mcap_file import RECORDING_VERSION
from ldo_service.runs.recorded_sequence import RecordingSequence
from ldo_service.runs.replayed import open_recording

GOLDEN = Path(__file__).parent / "golden"
FRAMES = 3  # Frames in each golden recording.


@pytest.fixture(params=sorted(path.name for path in GOLDEN.glob("*.tar.xz")))
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A recording of an earlier version."""
    with tarfile.open(GOLDEN / request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def test_there_is_a_recording_of_the_current_version() -> None:
    assert (GOLDEN / f"recording-v{RECORDING_VERSION}.tar.xz").exists()


def test_frames_of_an_earlier_recording_are_read(recording: Path) -> None:
    sequence = RecordingSequence(recording)
    assert len(sequence) == FRAMES
    for index in range(FRAMES):
        assert sequence.read(index).color.shape == (48, 64, 3)


def test_actors_of_an_earlier_recording_are_replayed(recording: Path) -> None:
    reports = {actor.name: actor.replay() for actor in open_recording(recording)}
    assert reports["frame_source"].taken["camera/rgbd"] == FRAMES
    assert reports["optimizer"].taken["keyframe/measurements"] == FRAMES
