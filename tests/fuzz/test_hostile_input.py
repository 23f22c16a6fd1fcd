"""Hostile input of every outside role ends no stage; `hostile_input.py` runs for any time."""

import logging

import pytest

from .hostile_input import run


@pytest.mark.parametrize("seed", range(3))
async def test_generated_input_ends_no_stage(seed: int) -> None:
    logging.disable(logging.CRITICAL)
    try:
        outcome = await run(seed, lambda inputs, _seconds: inputs >= 2000)
    finally:
        logging.disable(logging.NOTSET)
    assert outcome.handled > 0
    assert outcome.rejected > 0
    assert outcome.dead_letters == 0
