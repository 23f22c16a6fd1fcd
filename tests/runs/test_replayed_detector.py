"""Recording and replay of detections and of the labels from them."""

import asyncio
from pathlib import Path

import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.errors import ReplayDiverged
from ldo_service.runs.replayed import open_recording
from ldo_service.testing import replay_recording
from tests.detection.networks import squares_network
from tests.runs.conftest import record_service
from tests.runs.jobs import ROUGH

FRAMES = 8


def test_detections_replay_and_another_network_diverges(room: Sequence, tmp_path: Path) -> None:
    model = squares_network("yolov5", width=320, height=256).write(tmp_path / "squares.onnx")
    settings = (ROUGH, f"detector.model={model}", "detector.min_score=0")
    asyncio.run(
        record_service(tmp_path / "recording", room, load_config(settings=settings), FRAMES)
    )
    replayed = replay_recording(tmp_path / "recording", "detector", "mapper")
    assert replayed["detector"].made["detection/boxes"] >= 1
    assert replayed["mapper"].made["map/delta"] >= 1
    squares_network("yolov5", width=320, height=256, metadata="['a', 'b', 'c']").write(model)
    (actor,) = open_recording(tmp_path / "recording", ("detector",))
    with pytest.raises(ReplayDiverged, match="detection/boxes"):
        actor.verify()
