"""Tests of a live service that is recorded while actors are killed, and then replayed."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from tests.service.conftest import LDO, LiveService, live_service, wait_until

from .test_live import APART, EVERY_ACTOR

pytestmark = pytest.mark.slow


def publish(service: LiveService, frames: int) -> None:
    publisher = service.publisher("synthetic:tour", "--rate", "15", "--max-frames", str(frames))
    assert publisher.wait(60) == 0


def assert_replays(recording: Path) -> None:
    done = subprocess.run(
        [*LDO, "replay", str(recording), "--verify"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_recorded_service_replays(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    with live_service(tmp_path, "--record", str(recording)) as service:
        service.wait_for_actors()
        publish(service, 60)
        assert service.stop() == 0
    assert {path.stem for path in recording.iterdir()} == set(EVERY_ACTOR)
    assert_replays(recording)


def test_killed_and_restarted_actors_replay(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    with live_service(tmp_path, "--record", str(recording), *APART) as service:
        service.wait_for_actors()
        publisher = service.publisher("synthetic:tour", "--rate", "4")  # 90 s for seven actors.
        for actor in EVERY_ACTOR:
            service.wait_for_poses(10)
            pid = service.update_health()[actor].pid
            os.kill(pid, signal.SIGKILL)
            wait_until(
                lambda a=actor, pid=pid: service.update_health()[a].pid != pid,
                15,
                "the actor restarts",
            )
            service.poses()
        service.wait_for_poses(10)
        publisher.kill()
        publisher.wait()
        assert service.stop() == 0
    for actor in EVERY_ACTOR:
        assert (recording / f"{actor}.2.mcap").exists()
    assert_replays(recording)
