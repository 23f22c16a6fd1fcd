"""Tests of a real service with messages that kill the process of an actor."""

from pathlib import Path

import pytest

from ldo_service.runtime.quarantine import MAX_DELIVERIES
from tests.faults.camera import frames
from tests.faults.poison import PoisonRun


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_service_continues_after_messages_that_kill_their_process(tmp_path: Path) -> None:
    """The restart budget is larger than the default, because the messages come more often."""
    run = PoisonRun(tmp_path, frames(), ["supervision.max_restarts=1000"])
    result = run.run(duration_s=45.0, every_s=15.0)
    assert result.violations == [], result.summary()
    assert result.requested == len(result.deliveries) > 0
    assert {len(times) for times in result.deliveries.values()} == {MAX_DELIVERIES}
    assert result.restarts >= result.requested * MAX_DELIVERIES
    assert result.ends == 0
    assert max(result.placed) > max(result.deliveries)
