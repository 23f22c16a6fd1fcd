"""What `ldo doctor` and Prometheus say of a running service."""

import os
import signal
import subprocess
import urllib.request
from pathlib import Path

import pytest

from ldo_service.actors.topology import GRAPH
from tests.service.conftest import LDO, live_service, wait_until
from tests.transport.conftest import free_port


def doctor(endpoint: str) -> subprocess.CompletedProcess[str]:
    command = [*LDO, "doctor", "--endpoint", endpoint]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.timeout(300)
def test_the_doctor_names_a_stopped_process_and_a_service_without_frames(tmp_path: Path) -> None:
    with live_service(tmp_path, "--set", "service.silent_after_s=60") as service:
        service.wait_for_actors()
        well = doctor(service.endpoint)
        assert "had no frame yet on camera/rgbd, camera/color, camera/depth" in well.stdout
        assert "bad " not in well.stdout
        assert well.returncode == 0
        stopped = service.health["optimizer"].pid
        os.kill(stopped, signal.SIGSTOP)
        try:
            ill = doctor(service.endpoint)
        finally:
            os.kill(stopped, signal.SIGCONT)
        assert ill.returncode == 1
        assert "optimizer has a process, and no heartbeat" in " ".join(ill.stdout.split())


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_prometheus_sees_every_actor_count(tmp_path: Path) -> None:
    port = free_port()
    with live_service(tmp_path, "--metrics", str(port)) as service:
        service.wait_for_actors()
        publisher = service.publisher("synthetic:room", "--rate", "15", "--max-frames", "30")
        service.wait_for_poses(20)

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
            [*LDO, "serve", "--endpoint", f"tcp/127.0.0.1:{free_port()}", "--metrics", str(port)],
            capture_output=True,
            text=True,
        )
        assert second.returncode == 2
        assert f"--metrics {port}: cannot listen" in second.stderr
        assert "Traceback" not in second.stderr
        assert service.stop() == 0


def _value(text: str, name: str) -> float:
    found = [line.rsplit(" ", 1)[1] for line in text.splitlines() if line.startswith(name + " ")]
    return float(found[0]) if found else 0.0
