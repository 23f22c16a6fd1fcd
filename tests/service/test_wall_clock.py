"""Tests of a live service whose certificate expires, or whose wall clock is set, while it runs."""

import os
import re
import shutil
import subprocess
import time
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.schemas import CameraRgbd
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.keys import TlsKeys
from tests.faults.camera import frames
from tests.faults.service_process import LIGHT, children_of
from tests.ports import free_port
from tests.service.conftest import LiveService, live_service, wait_until

LIGHT_ARGUMENTS = tuple(word for setting in LIGHT for word in ("--set", setting))
FRAMES_PER_PHASE = 8
HOUR_S, DAY_S = 3600, 86_400
CLOCK_OFFSET = Path(__file__).with_name("clock_offset.cpp")
EXPIRY_METRIC = re.compile(r"^ldo_certificate_expiry_seconds(?:\{.*\})? (\S+)$", re.MULTILINE)


class Camera:
    """Camera whose frames are sent once each; the next one follows when the pose has arrived."""

    def __init__(self, service: LiveService) -> None:
        self._service, self._scene, self.sent = service, frames(), 0
        wait_until(lambda: service.client.has_subscriber, 20, "a subscriber of camera frames")

    def send(self, clock_offset_s: int = 0) -> CameraRgbd:
        """Send the next frame, stamped by a clock with an offset, and return it."""
        frame = msgspec.structs.replace(
            self._scene[self.sent % len(self._scene)],
            frame=self.sent,
            stamp_ns=time.time_ns() + clock_offset_s * 1_000_000_000,
        )
        self._service.client.send(frame)
        self.sent += 1
        return frame

    def status_of(self, frame: CameraRgbd) -> str:
        """Wait for the pose of a frame and return its status."""
        (pose,) = self._service.wait_for_poses(1)
        assert pose.stamp_ns == frame.stamp_ns
        return pose.status

    def statuses(self, clock_offset_s: int = 0) -> list[str]:
        """Send the frames of a phase and return the status of each pose."""
        return [self.status_of(self.send(clock_offset_s)) for _ in range(FRAMES_PER_PHASE)]


def processes_of(service: LiveService) -> set[int]:
    return {service.process.pid, *children_of(service.process.pid)}


def assert_continues(service: LiveService, processes: set[int], sent: int) -> None:
    """Check that no actor failed, was restarted or lost a frame, and that the service stops."""
    wait_until(lambda: handled(service) == sent, 20, "all frames in the heartbeat")
    health = service.update_health()
    assert {name: (of.restarts, of.failures) for name, of in health.items()} == dict.fromkeys(
        health, (0, 0)
    )
    assert processes_of(service) == processes
    assert health["mapper"].metrics["keyframes"] > 1
    assert service.stop() == 0


def handled(service: LiveService) -> int:
    return sum(count.delivered for count in service.update_health()["frame_source"].inputs)


@pytest.mark.slow
def test_no_pose_is_missed_when_the_certificate_expires(tmp_path: Path) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=30)
    viewer = TlsKeys(authority.add("desk", "viewer", "robot", days=20))
    for valid_s in (20, 60, 180):  # A busy machine may need more time for the start.
        made_at = datetime.now(UTC) - timedelta(days=1, seconds=-valid_s)
        keys = authority.add(f"mule-{valid_s}", "service", "robot", days=1, now=made_at)
        until_s = TlsKeys(keys).valid_until_s()
        assert until_s is not None
        folder = tmp_path / f"{valid_s}"
        folder.mkdir()
        with live_service(folder, *LIGHT_ARGUMENTS, keys=keys) as service:
            service.wait_for_actors()
            camera, processes = Camera(service), processes_of(service)
            before = camera.statuses()
            port = int(service.endpoint.rpartition(":")[2])
            if viewer.tls_error("127.0.0.1", port) or time.time() > until_s:
                continue
            during = []
            while time.time() < until_s + 3:
                during.append(camera.status_of(camera.send()))
            assert "expired" in viewer.tls_error("127.0.0.1", port)
            statuses = [*before, *during, *camera.statuses()]
            assert statuses == ["OK"] * camera.sent
            assert_continues(service, processes, camera.sent)
            return
    pytest.fail("the service did not start within 180 s")


class WallClock:
    """Wall clock of a service, with an offset to the clock of this machine."""

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which(os.environ.get("CXX", "c++"))
        if compiler is None:
            pytest.skip("needs a C++ compiler")
        library, self._file = folder / "clock_offset.so", folder / "clock_offset"
        options = ("-std=c++17", "-O2", "-shared", "-fPIC")
        command = [compiler, *options, "-o", str(library), str(CLOCK_OFFSET), "-ldl"]
        subprocess.run(command, check=True)
        self.variables = {"LD_PRELOAD": str(library), "CLOCK_OFFSET_FILE": str(self._file)}
        self.offset_s = 0
        self._file.write_bytes(bytes(8))

    def set(self, offset_s: int) -> None:
        """Set the clock; all processes of the service see it at once."""
        self.offset_s = offset_s
        with self._file.open("r+b") as file:
            file.write(np.int64(offset_s).tobytes())


@pytest.fixture
def clock(tmp_path: Path) -> WallClock:
    return WallClock(tmp_path)


@pytest.mark.slow
def test_no_pose_is_missed_when_the_wall_clock_of_the_robot_is_set(
    tmp_path: Path, clock: WallClock
) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=30)
    keys = authority.add("mule", "service", "robot", days=20)
    until_s = TlsKeys(keys).valid_until_s()
    assert until_s is not None
    port = free_port()
    metrics = ("--metrics-port", str(port))

    def shown_offset_s() -> float:
        """Return the offset of the clock by which the service computes the time to the expiry."""
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as reply:
            found = EXPIRY_METRIC.search(reply.read().decode())
        assert found is not None
        return until_s - time.time() - float(found[1])

    clock.set(-DAY_S)  # The certificate is not valid yet at this time.
    with live_service(
        tmp_path, *LIGHT_ARGUMENTS, *metrics, keys=keys, variables=clock.variables
    ) as service:
        service.wait_for_actors()
        processes, camera = processes_of(service), Camera(service)
        statuses = camera.statuses(clock.offset_s)
        for step_s in (DAY_S, HOUR_S, -HOUR_S, -HOUR_S, HOUR_S):
            frame = camera.send(clock.offset_s)
            clock.set(clock.offset_s + step_s)  # The frame is on its way.
            statuses += [camera.status_of(frame), *camera.statuses(clock.offset_s)]
            assert abs(shown_offset_s() - clock.offset_s) < HOUR_S / 2
        for pid in processes:
            assert "clock_offset.so" in Path(f"/proc/{pid}/maps").read_text()
        assert statuses == ["OK"] * camera.sent
        assert_continues(service, processes, camera.sent)
