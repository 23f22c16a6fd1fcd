"""Test of the quickstart: the commands of the manual in their order."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import open_sequence
from tests.service.conftest import LDO, LiveService, live_service, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

NETWORKS = ("--set", "detector.model=demo")
LIGHT = ("--set", "mapper.iterations=4")


def ldo(*words: object) -> str:
    """Run a command and return what it prints on both streams."""
    done = subprocess.run(
        [*LDO, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def track_folder(service: LiveService, folder: Path, poses: int) -> None:
    """Publish a folder of frames and require `poses` poses, all OK and in the map.

    A slow machine drops some of the frames.
    """
    camera = service.publisher(str(folder), "--rate", "5", "--restamp")
    tracked = service.wait_for_poses(poses, timeout_s=60)
    assert {(pose.status, pose.submap) for pose in tracked} <= {("OK", 0)}
    assert camera.wait(60) == 0


def test_run_serve_query_replay_resume_and_localize_a_folder(
    room_folder: Path, tmp_path: Path
) -> None:
    frames = len(open_sequence(str(room_folder)))
    # Offline run of a folder.
    ldo("run", room_folder, "--out", tmp_path / "run", "--hold-out-every", "5", *LIGHT, *NETWORKS)
    assert "ATE" in ldo("eval", tmp_path / "run", room_folder)
    assert "couch" in ldo("query", tmp_path / "run", "sofa")
    # Service with a camera, queried by another program.
    recording = tmp_path / "recording"
    with live_service(tmp_path, *LIGHT, *NETWORKS, "--record", str(recording)) as service:
        service.wait_for_actors()
        track_folder(service, room_folder, frames // 2)
        at = "--endpoint", service.endpoint
        wait_until(
            lambda: service.update_health()["mapper"].metrics["objects"] > 0, 20, "an object"
        )
        assert "couch" in ldo("query", "live", "sofa", *at)
        assert "mapper" in ldo("doctor", *at)
        service.process.kill()  # This simulates a power failure.
        service.process.wait()
    # The recording replays identically and can be used as a data set.
    ldo("replay", recording, "--verify")
    ldo("run", recording, "--out", tmp_path / "again", *LIGHT)
    # The service resumes after the kill.
    with live_service(tmp_path, *LIGHT, *NETWORKS) as service:
        service.wait_for_actors()
        assert "couch" in ldo("query", "live", "sofa", "--endpoint", service.endpoint)
        track_folder(service, room_folder, frames // 2)
        assert service.stop() == 0
    # Localization in the map of the run, which stays unchanged.
    before = (tmp_path / "run" / "map.ply").read_bytes()
    ldo("run", room_folder, "--out", tmp_path / "today", "--localize", tmp_path / "run")
    assert "ATE" in ldo("eval", tmp_path / "today", room_folder)
    assert (tmp_path / "run" / "map.ply").read_bytes() == before
