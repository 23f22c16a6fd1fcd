"""Test of the service over TLS, with certificates for each role."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.client import connect
from ldo_service.schemas import TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.transport.certificate_authority import CertificateAuthority
from tests.ports import free_endpoint
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
        doctor = [*LDO, "doctor", "--endpoint", here, "--keys", str(keys / "viewer")]
        wait_until(lambda: subprocess.run(doctor, capture_output=True).returncode == 0, 40, "up")
        to_camera = ("--endpoint", here, "--keys", str(keys / "camera"))
        frames = ("synthetic:room", "--rate", "15", "--max-frames", "30")
        camera = subprocess.Popen([*LDO, "publish", *frames, *to_camera])
        with connect("robot", here, keys / "viewer") as viewer:
            with viewer.poller(POSE_TRACKED.name, TrackedPose) as poses:
                found: list[TrackedPose] = []
                wait_until(lambda: len(found.extend(poses()) or found) >= 20, 20, "20 poses")
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
