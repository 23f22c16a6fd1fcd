"""Short fuzzing of all targets: the result is a value or one of the expected errors.

The program `fuzz.py` runs for any time.
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

SLOW = {
    "ONNX",
    "config.yaml",
    "ICL-NUIM, rendered: scene_00_0000.depth",
}  # Tens of milliseconds per body.


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level(logging.CRITICAL + 1):
        yield


@pytest.mark.parametrize("target", TARGETS.values(), ids=str)
def test_seed_is_read_without_error(target: Target, tmp_path: Path) -> None:
    """Mutations of an invalid seed would only reach the first check of a reader."""
    for seed in target.seeds[:1]:
        target.read(seed, tmp_path)


@pytest.mark.parametrize("target", TARGETS.values(), ids=str)
def test_damaged_bytes_raise_only_expected_errors(target: Target, tmp_path: Path) -> None:
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
