"""Tests of the service with a state folder that a power cut or a bad disk has damaged."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import DamagedStateError
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS
from tests.service.conftest import LDO, LiveService, free_endpoint, live_service, wait_until

EVERY_KEYFRAME = ("--set", "mapper.checkpoint_interval_keyframes=1")


def metric(service: LiveService, actor: str, name: str) -> float:
    health = service.update_health().get(actor)
    return health.metrics.get(name, 0.0) if health else 0.0


def newest_parts(state: Path, actor: str) -> list[Path]:
    folder = state / "state" / actor
    contents = read_contents(folder / CONTENTS)
    assert contents is not None
    return [folder / file for file in contents.files.values()]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


@pytest.mark.slow
def test_service_falls_back_once_and_says_so_in_log_and_heartbeat(
    tmp_path: Path, room: Sequence
) -> None:
    with live_service(tmp_path, *EVERY_KEYFRAME) as service:
        service.wait_for_actors()
        with service.camera(room):
            wait_until(lambda: metric(service, "mapper", "keyframes") >= 8, 60, "a map")
            generation = service.state / "state" / "generation.msgpack"
            first = read_contents(generation)
            wait_until(lambda: read_contents(generation) != first, 30, "another generation")
        keyframes = metric(service, "mapper", "keyframes")
        service.process.kill()
        service.process.wait(10)
        state = service.state
    cut(newest_parts(state, "tracker")[0])
    with live_service(tmp_path, *EVERY_KEYFRAME) as service:
        service.wait_for_actors()
        assert service.log.count("fall back to generation") == 1
        wait_until(lambda: metric(service, "mapper", "fell_back") == 1, 10, "a heartbeat")
        assert metric(service, "mapper", "keyframes") >= keyframes - 8
        with service.camera(room):
            wait_until(lambda: metric(service, "mapper", "keyframes") > keyframes, 60, "a map")
        assert metric(service, "mapper", "keyframes_repeated") == 0
        assert service.stop() == 0
    for path in (state / "state" / "tracker").iterdir():
        if not path.name.endswith(".msgpack"):
            cut(path)
    command = [*LDO, "serve", "--endpoint", free_endpoint(), "--state", str(state)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == DamagedStateError.exit_code
    assert done.stderr.count("is not usable either") == 1
