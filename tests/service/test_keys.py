"""Test of the service over TLS, with certificates for each role."""

import subprocess
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from ldo_service.client import connect
from ldo_service.schemas import TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.transport.certificate_authority import CertificateAuthority
from tests.ports import free_endpoint, free_port
from tests.service.conftest import LDO, wait_until


@pytest.mark.slow
def test_poses_are_received_over_tls_and_roles_are_enforced(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    authority = CertificateAuthority.new(keys, days=2)
    for role in ("service", "camera", "viewer", "operator"):
        authority.add(role, role, "robot", days=1)
    port = free_endpoint().rpartition(":")[2]
    here = f"tls/127.0.0.1:{port}"
    listen = ("--endpoint", f"tls/0.0.0.0:{port}", "--keys", str(keys / "service"))
    service = subprocess.Popen([*LDO, "serve", *listen, "--state", str(tmp_path / "s")])
    try:
        doctor = [
            *LDO,
            "doctor",
            "--window-s",
            "1.5",
            "--endpoint",
            here,
            "--keys",
            str(keys / "viewer"),
        ]
        wait_until(lambda: subprocess.run(doctor, capture_output=True).returncode == 0, 40, "up")
        to_camera = ("--endpoint", here, "--keys", str(keys / "camera"))
        frames = ("synthetic:room", "--rate", "8", "--max-frames", "40")
        camera = subprocess.Popen([*LDO, "publish", *frames, *to_camera])
        with connect("robot", here, keys / "viewer") as viewer:
            with viewer.poller(POSE_TRACKED.name, TrackedPose) as poses:
                found: list[TrackedPose] = []
                wait_until(lambda: len(found.extend(poses()) or found) >= 12, 20, "12 poses")
            assert {pose.status for pose in found} == {"OK"}
        assert camera.wait(60) == 0
        control = [*LDO, "control", "save", "--endpoint", here, "--keys"]
        assert subprocess.run([*control, str(keys / "operator")]).returncode == 0
        refused = subprocess.run([*control, str(keys / "viewer")], capture_output=True, text=True)
        assert refused.returncode == 2
        assert "no service replies on ldo/robot/control" in refused.stderr
    finally:
        service.terminate()
        assert service.wait(60) == 0


@pytest.mark.slow
def test_temporary_folders_of_a_killed_service_are_removed_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "t"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    keys = CertificateAuthority.new(tmp_path / "keys", days=2).add("mule", "service", "robot", 1)
    arguments = ("--endpoint", f"tls/127.0.0.1:{free_port()}", "--keys", str(keys))
    left = set[Path]()

    def has_new_socket() -> bool:
        return not left.issuperset(temporary.glob("ldo-*/link"))

    found = []
    for state in ((), (), ("--state", str(tmp_path / "s"))):
        with subprocess.Popen([*LDO, "serve", *arguments, *state]) as service:
            wait_until(has_new_socket, 40, "a new socket")
            service.kill()
        left |= set(temporary.glob("ldo-*/link"))
        found.append(len(list(temporary.glob("ldo-*"))))
    assert found == [2, 2, 1]  # One has the socket, and the other one a temporary state.


@pytest.mark.slow
@pytest.mark.parametrize("shift_days", [-3, 3], ids=["expired", "not valid yet"])
def test_invalid_certificate_of_the_robot_stops_no_actor(tmp_path: Path, shift_days: int) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=30)
    now = datetime.now(UTC) + timedelta(days=shift_days)
    keys = authority.add("mule", "service", "robot", days=1, now=now)
    endpoint, port = f"tls/127.0.0.1:{free_port()}", free_port()
    arguments = ("--endpoint", endpoint, "--keys", str(keys), "--metrics-port", str(port))
    with subprocess.Popen(
        [*LDO, "serve", *arguments, "--state", str(tmp_path / "s")],
        stderr=subprocess.PIPE,
        text=True,
    ) as service:

        def is_healthy() -> bool:
            assert service.poll() is None
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=60):
                    return True
            except OSError:
                return False

        wait_until(is_healthy, 20, "heartbeats of all actors, also of the child process")
        service.terminate()
        assert service.wait(60) == 0
        assert service.stderr is not None
        assert "The certificate" in service.stderr.read()
