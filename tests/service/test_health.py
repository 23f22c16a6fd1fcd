"""Tests of the output of `ldo doctor` and Prometheus for a running service."""

import os
import signal
import subprocess
import urllib.request
from pathlib import Path

import pytest

from ldo_service.actors.topology import GRAPH
from tests.commands.test_cli import ldo
from tests.ports import free_port
from tests.service.conftest import LDO, live_service, wait_until


def test_doctor_reports_stopped_process_and_missing_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def doctor() -> tuple[int, str]:
        code, out, _ = ldo(capsys, "doctor", "--window-s", "1.5", "--endpoint", service.endpoint)
        return code, " ".join(out.split())

    with live_service(tmp_path, "--set", "service.heartbeat_timeout_s=60") as service:
        service.wait_for_actors()

        def is_healthy() -> bool:
            code, out = doctor()
            assert "received no frame yet on camera/rgbd, camera/color, camera/depth" in out
            return code == 0 and "bad " not in out

        wait_until(is_healthy, 20, "every heartbeat comes")
        stopped = service.health["optimizer"].pid

        def is_stopped_process_named() -> bool:
            os.kill(stopped, signal.SIGSTOP)
            try:
                code, out = doctor()
            finally:
                os.kill(stopped, signal.SIGCONT)
            assert code == 1
            # The router drops a stopped process after some seconds; it then "is not running".
            return "optimizer has a process, but no heartbeat" in out

        wait_until(is_stopped_process_named, 60, "the stopped process is named")


@pytest.mark.slow
def test_prometheus_exports_metrics_of_every_actor(tmp_path: Path) -> None:
    port = free_port()
    with live_service(tmp_path, "--metrics-port", str(port)) as service:
        service.wait_for_actors()
        publisher = service.publisher("synthetic:room", "--rate", "8", "--max-frames", "30")
        service.wait_for_poses(12)

        def text() -> str:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as reply:
                return reply.read().decode()

        def value(name: str, actor: str) -> float:
            return _value(text(), f'{name}{{actor="{actor}",robot="robot"}}')

        wait_until(lambda: value("ldo_steps_total", "mapper") > 0, 10, "steps")
        for actor in (box.name for box in GRAPH):
            assert value("ldo_resident_bytes", actor) > 1e6
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=5) as reply:
            assert reply.read() == b"every actor reports\n"
        assert publisher.wait(20) == 0
        second = subprocess.run(
            [
                *LDO,
                "serve",
                "--endpoint",
                f"tcp/127.0.0.1:{free_port()}",
                "--metrics-port",
                str(port),
            ],
            capture_output=True,
            text=True,
        )
        assert second.returncode == 6
        assert f"--metrics-port {port}: cannot listen" in second.stderr
        assert "Traceback" not in second.stderr
        assert service.stop() == 0


def _value(text: str, name: str) -> float:
    found = [line.rsplit(" ", 1)[1] for line in text.splitlines() if line.startswith(name + " ")]
    return float(found[0]) if found else 0.0
