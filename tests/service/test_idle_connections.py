"""Test of a service whose TLS port is flooded with connections of programs without keys."""

import socket
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event, Thread

import pytest

from ldo_service.client import connect
from ldo_service.errors import LdoError
from ldo_service.schemas import TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.transport.certificate_authority import CertificateAuthority
from tests.ports import free_port
from tests.service.conftest import LDO, wait_until

MAX_FILES = 256  # Limit of open files of the service; systemd sets 1024.


class Flood(Thread):
    """Thread that keeps more connections open than the limit of open files of the service."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._port, self._stopped = port, Event()
        self.opened = 0

    def run(self) -> None:
        held: list[socket.socket] = []
        while not self._stopped.wait(0.05):
            for one in [one for one in held if _is_closed(one)]:
                one.close()
                held.remove(one)
            for _ in range(min(60, MAX_FILES + 60 - len(held))):
                with suppress(OSError):
                    held.append(socket.create_connection(("127.0.0.1", self._port), 0.3))
                    self.opened += 1
        for one in held:
            one.close()

    def stop(self) -> None:
        self._stopped.set()
        self.join()


def _is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@pytest.mark.slow
def test_idle_connections_prevent_neither_saving_nor_programs_with_keys(tmp_path: Path) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=2)
    for role in ("service", "camera", "operator"):
        authority.add(role, role, "robot", days=1)
    keys, port = tmp_path / "keys", free_port()
    here = f"tls/127.0.0.1:{port}"
    serve = (*LDO, "serve", "--endpoint", here, "--keys", str(keys / "service"))
    limited = ("bash", "-c", f'ulimit -n {MAX_FILES}; exec "$@"', "-")
    with ExitStack() as stack:
        service = subprocess.Popen([*limited, *serve, "--state", str(tmp_path / "s")])
        stack.callback(service.wait)
        stack.callback(service.terminate)
        control = [*LDO, "control", "save", "--endpoint", here, "--keys", str(keys / "operator")]
        wait_until(lambda: subprocess.run(control).returncode == 0, 40, "the service runs")
        flood = Flood(port)
        flood.start()
        stack.callback(flood.stop)
        wait_until(lambda: flood.opened > 4 * MAX_FILES, 20, "the port is flooded")
        descriptors = Path(f"/proc/{service.pid}/fd")
        assert len(list(descriptors.iterdir())) < MAX_FILES // 2
        frames = ("synthetic:room", "--rate", "15", "--max-frames", "30")
        to_camera = ("--endpoint", here, "--keys", str(keys / "camera"))

        def is_tracked() -> bool:
            """Return whether a new viewer gets a pose of a new camera."""
            poses: list[TrackedPose] = []
            with (
                suppress(LdoError),
                connect("robot", here, keys / "operator") as viewer,
                viewer.poller(POSE_TRACKED.name, TrackedPose) as new_poses,
            ):
                subprocess.run([*LDO, "publish", *frames, *to_camera])
                until_s = time.monotonic() + 5
                while not poses and time.monotonic() < until_s:
                    poses.extend(new_poses())
                    time.sleep(0.05)
            return bool(poses)

        wait_until(is_tracked, 40, "poses of a camera that connected during the flood")
        wait_until(lambda: subprocess.run(control).returncode == 0, 20, "the state is saved")
        assert service.poll() is None
