"""Test of a service that is killed between the resets of two actors."""

import time
from pathlib import Path
from threading import Thread

import pytest

from ldo_service.datasets import Sequence
from ldo_service.service.state_folder import RESET_MARKER
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS
from tests.service.conftest import (
    EVERY_KEYFRAME,
    LiveService,
    live_service,
    metric,
    service_with_map,
    wait_until,
)


def kill_after_reset_of_tracker(service: LiveService) -> None:
    contents = service.state / "state" / "tracker" / CONTENTS
    until_s = time.monotonic() + 60
    while not (service.state / RESET_MARKER).exists() and time.monotonic() < until_s:
        time.sleep(0.0005)
    before = contents.stat().st_ino  # The actors are paused now.
    while time.monotonic() < until_s:
        if not contents.exists() or contents.stat().st_ino != before:
            service.process.kill()
            return
        time.sleep(0.0005)


@pytest.mark.slow
def test_reset_that_a_kill_interrupts_is_completed_at_the_next_start(
    tmp_path: Path, room: Sequence
) -> None:
    with service_with_map(tmp_path, room, keyframes=4) as service:
        killer = Thread(target=kill_after_reset_of_tracker, args=(service,))
        killer.start()
        with pytest.raises(Exception, match="no service replies"):
            service.client.control("reset", timeout_s=10)
        killer.join()
        service.process.wait(10)
        mapper = read_contents(service.state / "state" / "mapper" / CONTENTS)
        assert mapper is not None
        assert "map" in mapper.files, "the mapper still has the state of the old run"
        assert (service.state / RESET_MARKER).exists()
    with live_service(tmp_path, *EVERY_KEYFRAME) as service:
        service.wait_for_actors()
        assert "completed now" in service.log
        assert not (service.state / RESET_MARKER).exists()
        with service.camera(room):
            wait_until(lambda: metric(service, "mapper", "keyframes") >= 4, 60, "a new map")
        assert metric(service, "mapper", "keyframes_repeated") == 0
        assert metric(service, "tracker", "keyframes") >= metric(service, "mapper", "keyframes")
        assert service.stop() == 0
