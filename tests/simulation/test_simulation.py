"""Tests of the runtime on a virtual clock; `simulation.py` runs more seeds."""

import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping

import pytest

from ldo_service.runtime import generations
from ldo_service.runtime.actor import Actor
from ldo_service.runtime.consumers import Consumers
from ldo_service.runtime.control import Control
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.state_saver import StateSaver
from ldo_service.storage.state_store import State
from ldo_service.transport.flow_control import Credit

from . import two_hosts
from .simulation import simulate

SEEDS, SLOW_SEEDS, SEEDS_PER_TEST = 100, 100, 20
# Seeds of which one has to show a fault of the runtime whose correction is taken out.
SEARCHED_SEEDS = 60


@pytest.fixture(autouse=True)
def _without_log() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(
    "first",
    [
        *range(0, SEEDS, SEEDS_PER_TEST),
        *(
            pytest.param(first, marks=pytest.mark.slow)
            for first in range(SEEDS, SEEDS + SLOW_SEEDS, SEEDS_PER_TEST)
        ),
    ],
)
def test_no_fault_violates_an_invariant_or_stops_the_service_for_long(first: int) -> None:
    reports = [simulate(seed) for seed in range(first, first + SEEDS_PER_TEST)]
    assert [report for report in reports if report.violations] == []
    assert max(report.keyframes for report in reports) > 5


def test_seed_repeats_its_run_in_another_process() -> None:
    seed = 3
    again = subprocess.run(
        [sys.executable, "-c", f"from tests.simulation.simulation import simulate\n"
                               f"print(simulate({seed}).digest)"],
        env={**os.environ, "PYTHONHASHSEED": "7"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert int(again.stdout) == simulate(seed).digest
    assert simulate(seed + 1).digest != simulate(seed).digest


def test_links_between_two_hosts_continue_within_5_s_after_a_bad_network() -> None:
    reports = [two_hosts.simulate(seed, max_duration_s=30.0) for seed in range(5)]
    assert [report for report in reports if report.violations] == []
    assert min(report.keyframes for report in reports) > 20


def test_links_between_two_hosts_without_retransmission_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 1e9)
    violations = two_hosts.simulate(4, max_duration_s=30.0).violations
    assert any("after healing: " in violation for violation in violations)
    assert any("after the last frame" in violation for violation in violations)


def is_reported(violation: str, only: str) -> bool:
    """Return whether a seed with one kind of fault shows a violation that contains a text."""
    return any(
        violation in found
        for seed in range(SEARCHED_SEEDS)
        for found in simulate(seed, (only,)).violations
    )


def test_evicted_consumer_that_waits_for_messages_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def is_still_stuck(consumers: Consumers, grant: Credit) -> bool:
        return grant.handled <= consumers._evicted.get(grant.consumer, -1)

    monkeypatch.setattr(Consumers, "is_still_stuck", is_still_stuck)
    assert is_reported("after the last fault", "loss")


def test_step_repeated_after_its_save_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(saver: StateSaver, actor: Actor, state: State) -> None:
        saver._outlets.store()
        saver._checkpointer.write(actor, state)
        saver._checkpointer.notify(actor)
        saver._update_metrics(actor)

    monkeypatch.setattr(StateSaver, "_write", write)
    assert is_reported("messages were repeated", "failure after save")


def test_mixed_states_after_an_interrupted_reset_are_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def mark_reset(control: Control) -> None:
        control._is_reset_pending = True

    unfitting = generations._inconsistent_states

    def without_epochs(pasts: Mapping[str, RestoredState]) -> Iterator[str]:
        yield from (problem for problem in unfitting(pasts) if "another run" not in problem)

    monkeypatch.setattr(Control, "_mark_reset", mark_reset)
    monkeypatch.setattr(generations, "_inconsistent_states", without_epochs)
    assert is_reported("states of two runs are mixed", "reset")
