"""Hostile input of every outside role ends no stage; `hostile_input.py` runs for any time."""

import asyncio
import logging
import random
import re
import sys
from collections.abc import Iterator

import pytest

from ldo_service.actors.tracker import Tracker
from ldo_service.schemas import Health
from ldo_service.schemas.topics import CAMERA_COLOR, CAMERA_DEPTH, ODOMETRY_PRIOR
from ldo_service.transport.interface import MemoryTransport

from . import hostile_input
from .hostile_input import MAX_MB, Generator, Service, run


@pytest.fixture(autouse=True)
def without_log() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.slow
async def test_generated_input_ends_no_stage() -> None:
    outcome = await run(0, lambda inputs, _seconds: inputs >= 300)
    counts = outcome.handled, outcome.rejected, outcome.keyframes, outcome.heartbeats
    assert min(counts) > 0, counts
    assert outcome.is_clean


@pytest.mark.slow
async def test_flood_of_large_messages_stays_within_256_mb() -> None:
    generator, transport = Generator(random.Random(0), ratio=0.0), MemoryTransport()
    service = Service(transport)
    await asyncio.sleep(0)
    peak_mb = 0.0
    try:
        for number in range(14):
            for topic in (CAMERA_COLOR, CAMERA_DEPTH, ODOMETRY_PRIOR):
                unknown_bytes = generator.random.randrange(30_000_000, 60_000_000)
                transport.deliver(topic.name, b"", generator.message(topic, unknown_bytes))
                peak_mb = max(peak_mb, service.queued_mb())
            if number >= 4:  # The first messages come before any is handled.
                await service.settle()
    finally:
        await service.stop()
    assert 64.0 < peak_mb <= MAX_MB


def exit_code(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["hostile_input.py", "--inputs", "100"])
    return hostile_input.main()


def test_program_succeeds_if_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert exit_code(monkeypatch) == 0


def test_program_fails_if_a_heartbeat_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_message: Health) -> bytes:
        raise OverflowError("a counter is too large")

    monkeypatch.setattr("ldo_service.runtime.stage.encode", fail)
    assert exit_code(monkeypatch) == 1


def test_program_prints_the_traceback_of_each_failed_message_with_seed_and_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("cannot be handled")

    monkeypatch.setattr(Tracker, "_track", fail)
    logging.disable(logging.NOTSET)
    assert exit_code(monkeypatch) == 1
    printed = capsys.readouterr().err
    assert printed.count("ValueError: cannot be handled") >= 2  # A message is tried twice.
    assert re.search(r"^seed 0, input [1-9]", printed, re.MULTILINE)
