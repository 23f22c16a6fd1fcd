"""Recording and replay of a lost camera that starts a submap and merges it."""

import asyncio
from pathlib import Path

import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.testing import replay_recording
from tests.runs.conftest import record_service
from tests.runs.jobs import AWAY, BACK, EARLY_SUBMAPS, HERE, ROUGH, Rearranged, quick_submaps


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_started_and_merged_submap_replays(room: Sequence, tmp_path: Path) -> None:
    order = [*HERE, *AWAY, *BACK]
    config = load_config(settings=(ROUGH, *EARLY_SUBMAPS))
    with quick_submaps():
        asyncio.run(record_service(tmp_path, Rearranged(room, order), config, len(order)))
        replayed = replay_recording(tmp_path)
    assert replayed["tracker"].made["pose/tracked"] == len(order)
    assert replayed["optimizer"].made["graph/correction"] > 5
