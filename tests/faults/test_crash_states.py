"""Tests of power cuts at random points of a run; `crash_states.py` tries more of them."""

import asyncio
from pathlib import Path

import pytest

from .crash_states import lost_keyframes, record_run


@pytest.mark.timeout(120)
@pytest.mark.parametrize(("syncs", "max_lost"), [(False, 5), (True, 0)])
def test_every_power_cut_is_followed_by_an_unattended_start(
    tmp_path: Path, syncs: bool, max_lost: int
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    log = asyncio.run(record_run(run, 6, syncs=syncs))
    lost, failed = lost_keyframes(log, 200, 1, tmp_path / "copy")
    assert failed == []
    assert max(lost) <= max_lost
