"""Tests of a live service with an actor that hangs or raises, and with malformed frames."""

import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import cycle
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest
import zenoh

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence
from ldo_service.geometry.frames import RgbdFrame
from ldo_service.schemas import CameraRgbd, TrackedPose, encode
from ldo_service.transport.zenoh_transport import Endpoint, open_session
from tests.service.conftest import LiveService, live_service, wait_until

FAULTY_PROGRAM = Path(__file__).with_name("faulty_tracker.py")
APART = ("--set", "service.process_actors=[optimizer,tracker]")


@pytest.fixture
def faulty_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """Return a function that starts a live service with a tracker fault at frame 20."""

    def start(fault: str, *arguments: str):
        monkeypatch.setenv("FAULT", fault)
        monkeypatch.setenv("FAULT_FOLDER", str(tmp_path))
        return live_service(tmp_path, *arguments, command=(sys.executable, str(FAULTY_PROGRAM)))

    return start


def message(room: Sequence, index: int) -> CameraRgbd:
    return raw_frame_to_message(room.read(index))


def tracked(service: LiveService, room: Sequence, indices: Iterable[int]) -> list[TrackedPose]:
    """Send frames, each after the previous one has its pose, and return the poses."""
    return [service.pose_of(message(room, index)) for index in indices]


@pytest.mark.slow
def test_process_with_a_hanging_handler_is_restarted(
    faulty_service: Callable, room: Sequence, tmp_path: Path
) -> None:
    # A busy machine must not make other steps exceed the timeout, so it is long.
    with faulty_service("hang", *APART, "--set", "supervision.step_timeout_s=12") as service:
        service.wait_for_actors()
        tracked(service, room, range(20))
        first = service.update_health()["tracker"].pid
        has_hung = tmp_path / "has_hung"
        service.send_until(message(room, 20), has_hung.exists, 20, "the handler hangs")
        wait_until(lambda: service.update_health()["tracker"].pid != first, 30, "a new process")
        assert {pose.status for pose in tracked(service, room, range(21, 26))} == {"OK"}
        assert "tracker has been busy with one message" in service.log
        assert "tracker: its process ended with exit code 4" in service.log
        assert service.stop() == 0


@pytest.mark.slow
def test_failing_message_becomes_a_dead_letter_and_tracking_continues(
    faulty_service: Callable, room: Sequence
) -> None:
    with faulty_service("once") as service:
        service.wait_for_actors()
        tracked(service, room, range(20))
        service.client.send(message(room, 20))
        wait_until(
            lambda: service.update_health()["tracker"].dead_lettered == 1, 20, "it is counted"
        )
        tracker = service.health["tracker"]
        assert (tracker.failures, tracker.restarts) == (2, 2)
        poses = tracked(service, room, range(21, 30))
        assert [(pose.frame, pose.status) for pose in poses] == [(i, "OK") for i in range(21, 30)]
        assert "failed twice and is discarded as a dead letter" in service.log
        assert service.stop() == 0


@pytest.mark.slow
def test_service_with_an_always_failing_actor_discards_each_frame_and_stays(
    faulty_service: Callable, room: Sequence
) -> None:
    with faulty_service("always") as service:
        service.wait_for_actors()
        tracked(service, room, range(20))
        # Each frame fails twice. More frames than the restart budget of 5 are discarded.
        frames = cycle(range(20, len(room)))

        def is_counted() -> bool:
            service.client.send(message(room, next(frames)))
            time.sleep(0.2)
            return service.update_health()["tracker"].dead_lettered > 6

        wait_until(is_counted, 60, "more frames than the budget are discarded")
        assert service.process.poll() is None
        assert service.stop() == 0


# --- malformed frames -----------------------------------------------------------------------------
def malformed_frames(good: CameraRgbd) -> Iterator[bytes]:
    """Yield bodies that a faulty or hostile program may send instead of a frame."""
    body = encode(good)
    fields = msgpack.unpackb(body)
    yield b""
    yield b"\xc1\xff\x00"
    yield body[: len(body) // 2]
    yield msgpack.packb({**fields, "type": "Keyframe"})
    yield msgpack.packb({"type": "CameraRgbd"})
    yield msgpack.packb({**fields, "camera": {**fields["camera"], "width": 1 << 14}})
    yield msgpack.packb({**fields, "color": {**fields["color"], "height": 239}})
    yield msgpack.packb({**fields, "camera": {**fields["camera"], "fx": float("nan")}})
    yield msgpack.packb({**fields, "depth_scale": 0.0})
    yield b"\x81\xa1y" + b"\x91" * 100_000
    yield bytes(65_000_000)  # Larger than service.max_decoded_message_mb.


@pytest.mark.slow
def test_malformed_frames_are_rejected_and_tracking_continues(
    tmp_path: Path, room: Sequence
) -> None:
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        good = message(room, 0)
        service.pose_of(good)
        bad = list(malformed_frames(good))
        with open_session(Endpoint("robot", service.endpoint)) as session:
            camera = session.declare_publisher(
                "ldo/robot/camera/rgbd", congestion_control=zenoh.CongestionControl.BLOCK
            )
            for number, body in enumerate(bad):
                send(service, camera, room, number)
                camera.put(body)
                wait_until(lambda n=number + 1: rejected(service) == n, 10, f"body {number}")
            poses = [send(service, camera, room, number) for number in range(len(bad), 20)]
        assert [pose.status for pose in poses] == ["OK"] * len(poses)
        assert service.health["frame_source"].failures == 0
        assert service.log.count("rejected") <= 2 * len(bad)
        assert service.stop() == 0
        assert "Traceback" not in service.log


def send(service: LiveService, camera: zenoh.Publisher, room: Sequence, index: int):
    """Send a frame as a camera without our package does, and return its pose."""
    frame = msgspec.structs.replace(message(room, index), stamp_ns=time.time_ns())
    return service.pose_of(frame, send=lambda copy: camera.put(encode(copy)))


def rejected(service: LiveService) -> int:
    return service.update_health()["frame_source"].inputs[0].rejected


@pytest.mark.slow
def test_tracking_recovers_after_frames_without_depth(tmp_path: Path, room: Sequence) -> None:
    """Color and depth come on two topics, and the depth is zero for some frames."""
    with live_service(tmp_path) as service:
        service.wait_for_actors()
        service.pose_of(message(room, 0))
        statuses = []
        for index in range(1, 25):
            halves = partial(send_halves, service, room[index], is_blind=9 <= index < 15)
            stamp_ns = 1_000_000_000 + index * 33_000_000
            frame = msgspec.structs.replace(message(room, index), stamp_ns=stamp_ns)
            statuses.append(service.pose_of(frame, halves).status)
        assert statuses[:8] == ["OK"] * 8
        assert "OK" not in statuses[8:14]
        assert statuses[-5:] == ["OK"] * 5
        wait_until(lambda: facts(service)["pairs"] >= 24, 5, "the pairs are counted")
        assert facts(service)["skew_ms_max"] == pytest.approx(2.0, abs=1e-3)
        assert service.stop() == 0
        assert "Traceback" not in service.log


def send_halves(
    service: LiveService, frame: RgbdFrame, copy: CameraRgbd, *, is_blind: bool
) -> None:
    """Send color and depth of a frame with the stamp of `copy`, the depth 2 ms later."""
    depth = np.zeros_like(frame.depth_m) if is_blind else frame.depth_m
    service.client.publish_color(frame.color, copy.camera, copy.stamp_ns)
    later_ns = copy.stamp_ns + 2_000_000
    service.client.publish_depth(depth, copy.camera, 1.0, stamp_ns=later_ns)


def facts(service: LiveService) -> dict[str, float]:
    return service.update_health()["frame_source"].metrics


@pytest.mark.slow
def test_service_stopped_during_a_long_step_exits_with_code_0(
    tmp_path: Path, room: Sequence
) -> None:
    with live_service(tmp_path, "--set", "mapper.iterations=100000") as service:
        service.wait_for_actors()
        service.pose_of(message(room, 0))
        wait_until(lambda: service.update_health()["mapper"].state == "busy", 20, "busy")
        service.process.send_signal(signal.SIGINT)
        wait_until(lambda: service.update_health()["mapper"].state == "draining", 20, "draining")
        assert service.stop() == 0
        assert "exited during a step of mapper" in service.log
