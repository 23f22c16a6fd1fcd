"""Recording of labels from a server, and replay without the server."""

import asyncio
from functools import partial
from pathlib import Path
from unittest.mock import patch

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.regions.region_tracker_config import RegionTrackerConfig
from ldo_service.runs.replayed import open_recording
from ldo_service.runtime.journal import StepRecord
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import LabelResult, decode
from ldo_service.testing import replay_recording
from tests.detection.labellers.server import replies_with, serving
from tests.runs.conftest import record_service
from tests.runs.jobs import ROUGH

FRAMES = 12
MANY_REQUESTS = (ROUGH, "mapper.open_vocabulary.requests_per_keyframe=4")  # The stream is short.
WITHOUT_DELAY = partial(RegionTrackerConfig, patience=0)


def has_answers(stages: dict[str, Stage]) -> bool:
    inputs = stages["mapper"].health().inputs
    return any(port.delivered for port in inputs if port.topic == "label/result")


def labels_received(folder: Path) -> list[str]:
    """Return the labels that the mapper received in a recording."""
    (mapper,) = open_recording(folder, ("mapper",))
    steps = [(f, s) for f in mapper.files for s in f.entries() if isinstance(s, StepRecord)]
    answers = [f.taken(step) for f, step in steps if step.topic == "label/result"]
    return [decode(body, LabelResult).label for body in answers]


def test_mapper_replays_with_the_label_results_that_it_received(
    room: Sequence, tmp_path: Path
) -> None:
    with serving(replies_with("samovar", 0.9)) as server:
        settings = (*MANY_REQUESTS, f"vlm_labeller.url={server.url}")
        config = load_config(settings=settings)
        with patch("ldo_service.config.parameters.RegionTrackerConfig", WITHOUT_DELAY):
            asyncio.run(
                record_service(tmp_path / "recording", room, config, FRAMES, until=has_answers)
            )
            replayed = replay_recording(tmp_path / "recording", "mapper", "vlm_labeller")
    assert "samovar" in labels_received(tmp_path / "recording")
    assert replayed["mapper"].made["label/request"] >= 1
    assert replayed["mapper"].made["map/objects"] >= 1
