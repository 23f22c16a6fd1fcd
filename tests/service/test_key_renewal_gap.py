"""Test that a service with renewed keys misses few frames.

`pytest -s` prints the missed frames and the longest time without a pose for each renewal.
"""

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError
from ldo_service.schemas import CameraRgbd, Health, TrackedPose
from ldo_service.schemas.topics import CAMERA_RGBD, FRAME_RGBD, POSE_TRACKED
from ldo_service.transport.access_control import LOCAL
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.keys import ACCESS, CERTIFICATE, DAY_S, KEY, TlsKeys
from tests.faults.camera import CameraStream, frames, number_of
from tests.ports import free_port
from tests.service.conftest import LDO, PATIENCE, wait_until

RATE_HZ = 5.0
# A renewal may interrupt the poses for 2 s. At 5 Hz, two poses that are 2 s apart have 9 frames
# between them. A busy machine delays the camera and the connections, so the test counts frames, and
# takes the renewal with the fewest.
MAX_MISSED = 9
RENEWED = "service: uses the new keys"
POSES = 8  # Poses that must arrive before and after a renewal.
RENEWALS = (70, 80, 89)  # Days for which each of the new keys is valid.


class Logs:
    """Frames and poses that programs have received: one on the robot, and a viewer with TLS."""

    def __init__(self, local: Client, remote: Client, stack: ExitStack) -> None:
        def listen(client: Client) -> Callable[[], list[TrackedPose]]:
            return stack.enter_context(client.poller(POSE_TRACKED.name, TrackedPose, keep=4096))

        self._local, self._remote = listen(local), listen(remote)
        self._frames = stack.enter_context(local.poller(CAMERA_RGBD.name, CameraRgbd))
        self._health = stack.enter_context(local.poller("health/tracker", Health))
        self._tracked = 0  # Frames that the tracker has handled, from its last heartbeat.
        self._arrived: set[int] = set()  # Frames that the router of the service has received.
        self._robot: set[int] = set()  # Frames whose pose has arrived on the robot.
        self.viewer: list[int] = []  # Frames whose pose has arrived at the viewer.
        self._times_s: list[float] = []  # Time of each of these arrivals.

    def update(self) -> None:
        for pose in self._remote():
            self.viewer.append(number_of(pose.stamp_ns))
            self._times_s.append(time.monotonic())
        self._robot.update(number_of(pose.stamp_ns) for pose in self._local())
        self._arrived.update(number_of(frame.stamp_ns) for frame in self._frames())

    def poses_since(self, frame: int) -> int:
        """Return the number of poses of later frames that the viewer has received."""
        self.update()
        return sum(later > frame for later in self.viewer)

    def missed_frames(self, first: int) -> int:
        """Return the number of consecutive frames, from `first` on, without a pose at the viewer.

        Frames that a busy tracker has dropped do not count.
        """
        received, missed, longest = set(self.viewer), 0, 0
        for frame in range(first, self.viewer[-1]):
            if frame in received:
                missed = 0
            elif frame in self._robot or frame not in self._arrived:
                missed += 1
                longest = max(longest, missed)
        return longest

    def longest_gap_s(self, first: int) -> float:
        """Return the longest time between two poses at the viewer, from a frame on, in seconds."""
        times_s = self._times_s[self.viewer.index(first) :]
        return max(after - before for before, after in pairwise(times_s))

    def robot_has_every_pose(self) -> bool:
        """Return whether a pose of each tracked frame has arrived on the robot."""
        self.update()
        for health in self._health():
            counts = {count.topic: count.delivered for count in health.inputs}
            self._tracked = counts[FRAME_RGBD.name]
        return self._tracked == len(self._robot)


@contextmanager
def service_with_keys(keys: Path, endpoint: str, folder: Path) -> Iterator[Path]:
    """Run a service, and yield the path of the Unix socket on which its router listens."""
    options = ("--endpoint", endpoint, "--keys", str(keys), "--state", str(folder / "s"))
    # The service makes its Unix socket in a temporary folder, whose path must be short.
    with (
        TemporaryDirectory() as private,
        (folder / "serve.log").open("w") as log,
        subprocess.Popen(
            [*LDO, "serve", *options], stderr=log, env={**os.environ, "TMPDIR": private}
        ) as service,
    ):
        try:
            wait_until(lambda: any(Path(private).glob("ldo-*/link")), 20, "a Unix socket")
            (link,) = Path(private).glob("ldo-*/link")
            yield link
            service.terminate()
            assert service.wait(PATIENCE * 15) == 0
        finally:
            service.kill()


def connected(stack: ExitStack, *arguments: str | Path) -> Client:
    """Connect to the service as soon as its router listens."""
    found: list[Client] = []

    def is_connected() -> bool:
        try:
            found.append(stack.enter_context(connect("robot", *arguments)))  # type: ignore[arg-type]
        except ConfigError:
            return False
        return True

    wait_until(is_connected, 20, "connected")
    return found[0]


@pytest.mark.slow
def test_renewed_keys_interrupt_the_poses_for_few_frames_and_on_the_robot_for_none(
    tmp_path: Path,
) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=90)
    for name, role in (("mule", "service"), ("front", "camera"), ("desk", "viewer")):
        authority.add(name, role, "robot", days=60)  # type: ignore[arg-type]
    keys, used, port = authority.folder, tmp_path / "mule", free_port()
    shutil.copytree(keys / "mule", used)
    endpoint = f"tls/127.0.0.1:{port}"
    missed: list[int] = []
    with service_with_keys(used, endpoint, tmp_path) as link, ExitStack() as stack:
        local = connected(stack, f"{LOCAL}/{link}")
        logs = Logs(local, connected(stack, endpoint, keys / "desk"), stack)
        camera = CameraStream(frames(), RATE_HZ)
        camera.start(connected(stack, endpoint, keys / "front"))
        stack.callback(camera.stop)
        wait_until(lambda: logs.poses_since(0) >= POSES, 30, "poses")
        for days in RENEWALS:
            authority.add(f"mule-{days}", "service", "robot", days=days)
            first, renewals = logs.viewer[-1], len(missed) + 1
            for file in (CERTIFICATE, KEY, ACCESS):
                shutil.copyfile(keys / f"mule-{days}" / file, used / file)

            def are_used(renewals: int = renewals) -> bool:
                logs.update()
                return (tmp_path / "serve.log").read_text().count(RENEWED) == renewals

            wait_until(are_used, 20, "new keys in use")
            wait_until(lambda n=camera.sent: logs.poses_since(n) >= POSES, 20, "poses afterwards")
            missed.append(logs.missed_frames(first))
            print(f"{missed[-1]} frames missed, {logs.longest_gap_s(first):.2f} s without a pose")
            until_s = TlsKeys(keys / "desk").server_valid_until_s("127.0.0.1", port)
            assert until_s is not None
            assert abs(until_s - time.time() - days * DAY_S) < DAY_S
        camera.stop()
        assert min(missed) <= MAX_MISSED
        wait_until(logs.robot_has_every_pose, 5, "a pose on the robot for each tracked frame")
