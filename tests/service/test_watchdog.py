"""Test of the notifications of the service to systemd."""

import os
import socket
import subprocess
from pathlib import Path

import pytest

from tests.ports import free_endpoint
from tests.service.conftest import LDO


@pytest.mark.slow
def test_service_notifies_systemd_of_start_watchdog_and_stop(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(120)
        variables = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
        service = subprocess.Popen(
            [*LDO, "serve", "--endpoint", free_endpoint()], env={**os.environ, **variables}
        )
        try:
            messages = [systemd.recv(100) for _ in range(4)]
            assert sorted(set(messages)) == [b"READY=1", b"WATCHDOG=1"]
            service.terminate()
            while systemd.recv(100) != b"STOPPING=1":
                pass
            assert service.wait(120) == 0
        finally:
            service.kill()
            service.wait()
