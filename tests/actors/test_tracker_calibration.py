"""Tracker that starts with the calibration of an earlier run."""

import json
from pathlib import Path

import pytest

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.errors import DataError
from ldo_service.schemas import Keyframe
from ldo_service.storage.state_codec import decode_state, encode_state

CORRECTION = {
    "depth_bias": [0.01, 0.0, -0.01],
    "vignetting": [[-0.3, 0.1, 0.0]] * 3,
    "readout_s": 0.02,
    "depth_readout_s": 0.01,
    "depth_delay_s": 0.005,
}


@pytest.fixture
def calibration_run(tmp_path: Path) -> TrackerConfig:
    keyframe = {"keyframe": 0, "stamp_ns": 0, "camera_correction": CORRECTION}
    (tmp_path / "keyframes.json").write_text(json.dumps([keyframe]))
    return TrackerConfig(calibration_run=str(tmp_path))


def test_first_keyframe_has_the_correction_of_the_earlier_run(
    calibration_run: TrackerConfig, frames
) -> None:
    tracker = Tracker(calibration_run)
    first, *_ = tracker.handle(frames[0])
    assert isinstance(first, Keyframe)
    assert first.camera_correction.depth_bias == (0.01, 0.0, -0.01)
    assert first.camera_correction.vignetting == ((-0.3, 0.1, 0.0),) * 3
    metrics = tracker.metrics()
    assert metrics["depth_bias_corrected"] == 1
    assert metrics["readout_ms"] == pytest.approx(20)
    assert metrics["depth_readout_ms"] == pytest.approx(10)
    assert metrics["depth_delay_ms"] == pytest.approx(5)


def test_restored_tracker_has_the_metrics_of_its_calibration(
    calibration_run: TrackerConfig, frames
) -> None:
    tracker = Tracker(calibration_run)
    for frame in frames[:3]:
        list(tracker.handle(frame))
    restored = Tracker(calibration_run)
    restored.restore(decode_state(encode_state(tracker.snapshot())))
    expected = tracker.metrics()
    assert expected["readout_ms"] == pytest.approx(20)
    for name in ("readout_ms", "calibration_finished", "depth_bias_residual_ratio"):
        assert restored.metrics()[name] == expected[name], name


def test_folder_without_a_run_raises_data_error(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"tracker\.calibration_run=.*keyframes\.json cannot be read"
    ):
        Tracker(TrackerConfig(calibration_run=str(tmp_path)))
