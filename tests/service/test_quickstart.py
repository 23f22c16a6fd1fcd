"""What a stranger does on the first day, in the order of the manual, each by its command."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import open_sequence
from tests.service.conftest import LDO, LiveService, live_service, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

NETWORKS = ("--set", "detector.model=demo")
LIGHT = ("--set", "mapper.iterations=4")


def ldo(*words: object) -> str:
    """What a command prints on both its streams."""
    done = subprocess.run(
        [*LDO, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def see(service: LiveService, folder: Path, poses: int) -> None:
    """Have a camera go through a folder of frames, and answer with OK poses in the map; on a slow
    machine some frames are dropped."""
    camera = service.publisher(str(folder), "--rate", "5", "--restamp")
    told = service.wait_for_poses(poses, timeout_s=60)
    assert {(pose.status, pose.submap) for pose in told} <= {("OK", 0)}
    assert camera.wait(60) == 0


def test_folder_run_service_query_recording_resume_and_localizing(
    room_folder: Path, tmp_path: Path
) -> None:
    frames = len(open_sequence(str(room_folder)))
    # a folder of one's own
    ldo("run", room_folder, "--out", tmp_path / "run", "--hold-out-every", "5", *LIGHT, *NETWORKS)
    assert "ATE" in ldo("eval", tmp_path / "run", room_folder)
    assert "couch" in ldo("query", tmp_path / "run", "sofa")
    # a service, a camera, another program, and a question
    recording = tmp_path / "recording"
    with live_service(tmp_path, *LIGHT, *NETWORKS, "--record", str(recording)) as service:
        service.wait_for_actors()
        see(service, room_folder, frames // 2)
        at = "--endpoint", service.endpoint
        wait_until(
            lambda: service.update_health()["mapper"].metrics["objects"] > 0, 20, "an object"
        )
        assert "couch" in ldo("query", "live", "sofa", *at)
        assert "mapper" in ldo("doctor", *at)
        service.process.kill()  # as a power cut would
        service.process.wait()
    # what was recorded gives the same again, and is a data set
    ldo("replay", recording, "--verify")
    ldo("run", recording, "--out", tmp_path / "again", *LIGHT)
    # gone on from, after the kill
    with live_service(tmp_path, *LIGHT, *NETWORKS) as service:
        service.wait_for_actors()
        assert "couch" in ldo("query", "live", "sofa", "--endpoint", service.endpoint)
        see(service, room_folder, frames // 2)
        assert service.stop() == 0
    # tracked in the map of the run, which stays as it is
    before = (tmp_path / "run" / "map.ply").read_bytes()
    ldo("run", room_folder, "--out", tmp_path / "today", "--localize", tmp_path / "run")
    assert "ATE" in ldo("eval", tmp_path / "today", room_folder)
    assert (tmp_path / "run" / "map.ply").read_bytes() == before
