"""Tests of power cuts at random points of a run; `crash_states.py` tries more of them."""

import asyncio
from pathlib import Path

import pytest

from .crash_starts import power_cuts, start_all
from .crash_states import lost_keyframes, record_run
from .small_service import ACTORS


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


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("syncs", "max_lost"), [(False, 5), (True, 0)])
def test_all_actors_start_after_a_power_cut_and_handle_the_next_frames(
    tmp_path: Path, syncs: bool, max_lost: int
) -> None:
    """Start all actors from 105 states, in 75 s of CPU time."""
    run = tmp_path / "run"
    run.mkdir()
    log = asyncio.run(record_run(run, 10, syncs=syncs))
    states = power_cuts(log, 105, 1)
    starts, failed = asyncio.run(start_all(states, tmp_path, syncs=syncs))
    assert failed == []
    assert max(start.lost_keyframes for start in starts) <= max_lost
    for actor in ACTORS:
        assert any(actor in start.restored for start in starts)
    assert any(start.is_fall_back for start in starts) != syncs
