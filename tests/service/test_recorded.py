"""Test of a live service that is recorded while actors are killed, and then replayed."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import open_sequence
from tests.service.conftest import LDO, live_service, wait_until

from .test_live import APART, EVERY_ACTOR

pytestmark = pytest.mark.slow


def test_service_continues_after_each_actor_is_killed_and_replays(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    with live_service(tmp_path, "--record", str(recording), *APART) as service:
        service.wait_for_actors()
        with service.camera(open_sequence("synthetic:tour"), rate_hz=4):
            service.wait_for_poses(10)
            for actor in EVERY_ACTOR:
                old = service.update_health()[actor]
                os.kill(old.pid, signal.SIGKILL)
                wait_until(
                    lambda a=actor, pid=old.pid: service.update_health()[a].pid != pid,
                    15,
                    f"{actor} comes back",
                )
                service.poses()
                steps = service.health["optimizer"].steps
                poses = service.wait_for_poses(10)
                assert sum(pose.status == "OK" for pose in poses) >= 8, f"after {actor}"
                assert f"{actor}: its process was killed by signal 9" in service.log
                wait_until(
                    lambda s=steps: service.update_health()["optimizer"].steps != s, 10, "keyframes"
                )
        assert service.stop() == 0
    for actor in EVERY_ACTOR:
        assert (recording / f"{actor}.2.mcap").exists()
    done = subprocess.run(
        [*LDO, "replay", str(recording), "--verify"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
