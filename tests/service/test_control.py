"""Tests of the command `ldo control` on a running service."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import Sequence
from ldo_service.schemas.topics import MAP_SNAPSHOT
from tests.service.conftest import LDO, LiveService, live_service, wait_until


def ldo_control(service: LiveService, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [*LDO, "control", *arguments, "--endpoint", service.endpoint]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
def test_live_service_pauses_refines_resumes_saves_and_resets(
    tmp_path: Path, room: Sequence
) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        with service.camera(room):
            service.wait_for_poses(15)
            # Pause: frames arrive and no pose is published.
            assert ldo_control(service, "pause").returncode == 0
            service.poses()
            wait_until(lambda: _paused(service) > 5, 10, "paused frames are counted")
            assert service.poses() == []
            # Refine: no keyframe arrives, and the mapper iterates.
            before = _iterations(service)
            assert ldo_control(service, "refine", "--iterations", "501").returncode == 2
            assert ldo_control(service, "refine", "--iterations", "40").returncode == 0
            wait_until(lambda: _iterations(service) >= before + 40, 20, "40 iterations more")
            assert service.client.control("resume").ok
            last = service.wait_for_poses(15)[-1]
            assert last.keyframe is None or last.keyframe > 0
            # Save: the complete map is on the disk before its next regular checkpoint.
            saved = ldo_control(service, "save")
            assert (saved.returncode, str(tmp_path / "s") in saved.stdout) == (0, True)
            for actor in ("frame_source", "tracker", "mapper", "optimizer"):
                assert (tmp_path / "s" / "state" / actor / "contents.msgpack").exists()
            # Reset: all actors start from an empty state in the same processes.
            before = {name: (h.epoch, h.pid) for name, h in service.update_health().items()}
            assert ldo_control(service, "reset").returncode == 0
            service.wait_for_poses(1)
            wait_until(
                lambda: all(h.epoch != before[a][0] for a, h in service.update_health().items()),
                10,
                "new epochs",
            )
            assert {name: h.pid for name, h in service.health.items()} == {
                name: pid for name, (_, pid) in before.items()
            }
            poses = service.wait_for_poses(15)
            assert all(pose.status == "OK" for pose in poses)
            wait_until(
                lambda: bool(service.client.latest(MAP_SNAPSHOT, timeout_s=60)), 10, "a new map"
            )
            wait_until(
                lambda: service.update_health()["optimizer"].metrics.get("optimizations", 0) > 0,
                10,
                "corrections of the new run",
            )
        assert service.client.control("dance").message.startswith("unknown command 'dance'")
        assert service.stop() == 0
        assert "Traceback" not in service.log


def _paused(service: LiveService) -> int:
    return sum(count.dropped_paused for count in service.update_health()["frame_source"].inputs)


def _iterations(service: LiveService) -> float:
    return service.update_health()["mapper"].metrics["iterations"]


@pytest.mark.slow
def test_unknown_robot_exits_with_code_2_and_unresponsive_actor_with_code_4(
    tmp_path: Path,
) -> None:
    arguments = ("--set", "service.control_timeout_s=1", "--set", "service.heartbeat_timeout_s=30")
    with live_service(tmp_path, *arguments) as service:
        service.wait_for_actors()
        done = ldo_control(service, "pause", "--robot", "r2")
        assert done.returncode == 2
        assert "Check the name of the robot" in done.stderr
        stopped = service.health["optimizer"].pid
        os.kill(stopped, signal.SIGSTOP)
        try:
            done = ldo_control(service, "save")
            assert done.returncode == 4
            assert "optimizer did not answer" in done.stderr
        finally:
            os.kill(stopped, signal.SIGCONT)
