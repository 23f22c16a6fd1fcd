"""The service under systemd's protocol."""

import os
import socket
import subprocess
from pathlib import Path

import pytest

from tests.ports import free_endpoint
from tests.service.conftest import LDO


@pytest.mark.slow
def test_a_service_says_when_it_is_up_pings_and_says_that_it_stops(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(120)
        told = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
        service = subprocess.Popen(
            [*LDO, "serve", "--endpoint", free_endpoint()], env={**os.environ, **told}
        )
        try:
            words = [systemd.recv(100) for _ in range(4)]
            assert sorted(set(words)) == [b"READY=1", b"WATCHDOG=1"]
            service.terminate()
            while systemd.recv(100) != b"STOPPING=1":
                pass
            assert service.wait(120) == 0
        finally:
            service.kill()
            service.wait()
