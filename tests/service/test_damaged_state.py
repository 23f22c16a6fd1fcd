"""Tests of the service with a state folder that a power cut or a bad disk has damaged."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.datasets import Sequence
from ldo_service.errors import DamagedStateError
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS
from tests.service.conftest import (
    EVERY_KEYFRAME,
    LDO,
    free_endpoint,
    live_service,
    metric,
    service_with_map,
    wait_until,
)


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
    with service_with_map(tmp_path, room) as service:
        with service.camera(room):
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
