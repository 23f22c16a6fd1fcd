"""Whatever bytes arrive, the answer is a value, or a refusal of the kind that callers expect.

A short run; `fuzz.py` beside this file goes on for as long as it is told.
"""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .mutation import mutated
from .target import Target
from .targets import TARGETS

SLOW = {"ONNX", "config.yaml"}  # tens of milliseconds each


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level(logging.CRITICAL + 1):
        yield


@pytest.mark.parametrize("target", TARGETS.values(), ids=str)
def test_seeds_are_what_they_stand_for(target: Target, tmp_path: Path) -> None:
    """Or their changes would be judged by the first check alone."""
    for seed in target.seeds[:1]:
        target.read(seed, tmp_path)


@pytest.mark.parametrize("target", TARGETS.values(), ids=str)
def test_what_is_damaged_is_refused(target: Target, tmp_path: Path) -> None:
    @settings(
        max_examples=5 if target.name in SLOW else 40,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def run(data: st.DataObject) -> None:
        target.attempt(data.draw(mutated(target.seeds)), tmp_path)

    run()
