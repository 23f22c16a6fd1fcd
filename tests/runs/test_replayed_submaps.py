"""A lost camera that begins a submap and joins it, recorded and lived again."""

import asyncio
from pathlib import Path

import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.testing import replay_recording
from tests.runs.conftest import live
from tests.runs.jobs import AWAY, BACK, HERE, ROUGH, SOON, Rearranged, quick_submaps


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_lost_and_joined_submap_replays(room: Sequence, tmp_path: Path) -> None:
    order = [*HERE, *AWAY, *BACK]
    config = load_config(settings=(ROUGH, *SOON))
    with quick_submaps():
        asyncio.run(live(tmp_path, Rearranged(room, order), config, len(order)))
        replayed = replay_recording(tmp_path)
    assert replayed["tracker"].made["pose/tracked"] == len(order)
    assert replayed["optimizer"].made["graph/correction"] > 5
