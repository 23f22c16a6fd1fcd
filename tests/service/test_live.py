"""Tests of the live service as users see it: processes, sockets and signals."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ldo_service.actors.topology import GRAPH
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DamagedStateError
from ldo_service.runtime.generations import completed_generation
from ldo_service.schemas import MapSnapshot, TrackedPose
from ldo_service.schemas.topics import MAP_SNAPSHOT, POSE_TRACKED
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import NEWEST, FolderStore, list_name
from tests.ports import free_endpoint
from tests.service.conftest import (
    LDO,
    PATIENCE,
    LiveService,
    is_running,
    live_service,
    wait_until,
)

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
EVERY_ACTOR = tuple(box.name for box in GRAPH)
# The map is light, because a restarted process needs a free core.
APART = (
    "--set",
    f"service.process_actors=[{','.join(EVERY_ACTOR)}]",
    "--set",
    "mapper.iterations=2",
)


def test_frames_yield_poses_and_a_map(tmp_path: Path) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        # A busy machine drops frames; at this rate enough of them remain.
        publisher = service.publisher("synthetic:room", "--rate", "5", "--max-frames", "25")
        poses = service.wait_for_poses(8)
        assert publisher.wait(PATIENCE * 20) == 0
        poses += service.poses()
        assert {pose.status for pose in poses} == {"OK"}
        last = service.client.latest(POSE_TRACKED, timeout_s=60)
        assert isinstance(last[0], TrackedPose)
        assert service.client.latest("pose/tracked", timeout_s=60) == last
        health_messages = service.client.messages("health", keep=16)
        silent = set(EVERY_ACTOR)
        while silent:
            silent.discard(next(health_messages)[1].actor)
        with pytest.raises(ConfigError, match="Did you mean pose/tracked"):
            service.client.latest("pose/traked")
        with pytest.raises(ConfigError, match="map/delta keeps no last value"):
            service.client.latest("map/delta")
        parts = service.client.latest(MAP_SNAPSHOT, timeout_s=60)
        assert all(isinstance(part, MapSnapshot) for part in parts)
        assert sum(part.gaussians.ids.shape[0] for part in parts) > 1000
        assert service.stop() == 0
        assert "Traceback" not in service.log


@pytest.fixture(scope="module")
def running_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """Yield a service that several tests use in any order; they must not stop it."""
    with live_service(tmp_path_factory.mktemp("running")) as service:
        service.wait_for_actors()
        yield service


def test_used_port_is_reported_without_traceback(running_service: LiveService) -> None:
    second = subprocess.run(
        [*LDO, "serve", "--endpoint", running_service.endpoint], capture_output=True, text=True
    )
    assert second.returncode == 6
    assert "another `ldo serve`" in second.stderr
    assert "Traceback" not in second.stderr


def test_odometry_example_delivers_its_poses(running_service: LiveService, tmp_path: Path) -> None:
    poses = tmp_path / "odometry.txt"
    poses.write_text(
        "# stamp tx ty tz qx qy qz qw\n1.00 0 0 0 0 0 0 1\n1.02 0 0 0.01 0 0 0.6 0.8\n"
    )
    example = _at(running_service.endpoint, EXAMPLES / "4_publish_odometry.py")
    done = subprocess.run([sys.executable, "-c", example, str(poses)])
    assert done.returncode == 0

    def delivered_poses() -> int:
        inputs = running_service.update_health()["tracker"].inputs
        return sum(i.delivered for i in inputs if i.topic == "odometry/prior")

    wait_until(lambda: delivered_poses() == 2, 10, "both poses are delivered")
    assert "rejected" not in running_service.log


def test_examples_run_as_printed(running_service: LiveService) -> None:
    camera, package_subscriber, zenoh_subscriber = (
        running_service.start(
            [sys.executable, "-c", _at(running_service.endpoint, EXAMPLES / name), count],
            stdout=subprocess.PIPE,
            text=True,
        )
        for name, count in (
            ("1_publish_a_camera.py", "10000"),
            ("2_follow_the_pose.py", "5"),
            ("3_without_our_package.py", "5"),
        )
    )
    for subscriber in (package_subscriber, zenoh_subscriber):
        printed, _ = subscriber.communicate(timeout=30 * PATIENCE)
        lines = printed.splitlines()
        assert len(lines) == 5
        assert all(line.split()[1] == "OK" for line in lines)
    camera.kill()
    camera.wait()


def _at(endpoint: str, example: Path) -> str:
    """Return the text of an example with the address of the service instead of the default."""
    text = example.read_text().replace("tcp/127.0.0.1:7447", endpoint)
    return text.replace('connect("robot")', f'connect("robot", "{endpoint}")')


@pytest.mark.slow
def test_state_folder_is_resumed_and_shared_or_partial_ones_rejected(
    tmp_path: Path, room: Sequence
) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        for index in range(30):
            service.pose_of(raw_frame_to_message(room.read(index)))
        state = tmp_path / "s"
        assert "another service uses the state" in start_error(state, exit_code=6)
        wait_until(lambda: service.update_health()["mapper"].metrics["keyframes"] > 2, 10, "a map")
        assert service.stop() == 0
        keyframes = service.health["mapper"].metrics["keyframes"]
    assert last_generation(state) == newest_states(state), "a power cut now loses nothing"
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        for index in range(30, 60):
            service.pose_of(raw_frame_to_message(room.read(index)))
        wait_until(
            lambda: service.update_health()["mapper"].metrics.get("keyframes", 0) > keyframes,
            10,
            "the map grows",
        )
        assert service.stop() == 0
    for part in (state / "state" / "tracker").iterdir():
        part.write_bytes(b"damaged")
    assert "is not usable either" in start_error(state, DamagedStateError.exit_code)


def newest_states(state: Path, generation: int = NEWEST) -> list[dict[str, tuple[int, int]]]:
    """Return the size and checksum of each part of each saved state."""
    lists = (read_contents(state / "state" / a / list_name(generation)) for a in EVERY_ACTOR)
    return [contents.checks if contents else {} for contents in lists]


def last_generation(state: Path) -> list[dict[str, tuple[int, int]]]:
    number = completed_generation(FolderStore(state / "state"))
    assert number is not None
    return newest_states(state, number)


def start_error(state: Path, exit_code: int) -> str:
    """Return the error of a service that cannot use a state folder."""
    done = subprocess.run(
        [*LDO, "serve", "--endpoint", free_endpoint(), "--state", str(state)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == exit_code
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.slow
def test_child_processes_end_when_the_service_is_killed(tmp_path: Path) -> None:
    with live_service(tmp_path, *APART) as service:
        service.wait_for_actors()
        pids = [health.pid for health in service.health.values()]
        assert len(set(pids)) == len(EVERY_ACTOR)
        service.process.kill()
        service.process.wait()
        wait_until(lambda: not any(map(is_running, pids)), 10, "the children leave")


@pytest.mark.slow
def test_tracking_continues_after_the_publisher_is_restarted(tmp_path: Path) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        first = service.publisher("synthetic:room", "--rate", "8")
        service.wait_for_poses(15)
        first.kill()
        first.wait()
        service.poses()
        second = service.publisher("synthetic:room", "--rate", "8")
        poses = service.wait_for_poses(30)
        assert sum(pose.status == "OK" for pose in poses) >= 25
        second.kill()
        second.wait()


@pytest.mark.slow
def test_slow_subscriber_does_not_delay_poses(tmp_path: Path) -> None:
    """If the service waited for the subscriber, a quarter of the frames would have no pose."""
    slow_subscriber = (
        "import time, zenoh, json, sys\n"
        "config = zenoh.Config()\n"
        "config.insert_json5('mode', json.dumps('client'))\n"
        "config.insert_json5('connect/endpoints', json.dumps([sys.argv[1]]))\n"
        "with zenoh.open(config) as session:\n"
        "    queue = zenoh.handlers.FifoChannel(1)\n"
        "    with session.declare_subscriber('ldo/robot/**', queue) as everything:\n"
        "        for _ in everything:\n"
        "            time.sleep(1)\n"
    )
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        service.start([sys.executable, "-c", slow_subscriber, service.endpoint])
        service.publisher("synthetic:room", "--rate", "5", "--max-frames", "100")
        poses = service.wait_for_poses(85, timeout_s=15)
        assert sum(pose.status == "OK" for pose in poses) >= 82
