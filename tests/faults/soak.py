"""Live service for an hour, with TLS keys, default settings, commands and faults.

    .venv/bin/python -m tests.faults.soak soak.jsonl --minutes 60
    .venv/bin/python -m tests.faults.soak_summary soak.jsonl

A camera moves to and fro through the synthetic tour and sends every second frame of it at 2 Hz. The
map is complete with 500 keyframes, whose images fill the default memory for them. A fault follows
every five minutes, and a command every minute. The file gets a JSON object for each sample, command
and fault. The second program summarizes such a file. The exit code is 1 if no pose came for longer
than 60 s, if a process ended that no fault ended, if a command was refused, or if there is more
than one temporary folder of the service.
"""

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import mkdtemp
from threading import Event, Lock, Thread, Timer
from typing import Any

from ldo_service.client import Client, connect
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from ldo_service.errors import LdoError
from ldo_service.schemas import Health, TrackedPose
from ldo_service.schemas.topics import CAMERA_RGBD
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_port

from .camera import CameraStream, and_back
from .service_process import children_of
from .soak_summary import COMMANDS, MEASURED, read_lines, summary

RATE_HZ, SAMPLE_S, COMMAND_S, PAUSE_S = 2.0, 10.0, 60.0, 2.0
STRIDE = 2  # Every second frame of the tour, so that the map is complete early.
SYSTEMD_PAUSE_S = 5.0  # RestartSec in deploy/ldo@.service.
STOP_S, HELD_S, CONNECTIONS = 15.0, 60.0, 100
MAX_GAP_S, PATIENCE_S = 60.0, 120.0
MODELS = ("detector.model=demo", "vlm_labeller.model=demo")
# The default of 1500 keyframes would take most of an hour.
MAP = ("tracker.keyframes.reuse_after=500",)
SIZES = ("keyframes", "gaussians", "keyframes_cache_mb")  # Metrics of the mapper.

# Program that reads the map and its changes. Arguments: endpoint and folder of keys.
READER = """
import sys, time
from ldo_service.client import connect
with connect("robot", sys.argv[1], sys.argv[2]) as client:
    while not client.latest("map/snapshot", 30.0):
        time.sleep(1.0)
    print("reading", flush=True)
    for _ in client.messages("map/delta", 64):
        client.latest("map/snapshot", 30.0)
"""


class Service:
    """Service with TLS keys and default settings, and its processes."""

    def __init__(self, folder: Path, settings: Sequence[str]) -> None:
        self._folder, self.keys = folder, folder / "keys"
        self._settings = [word for one in (*MODELS, *MAP, *settings) for word in ("--set", one)]
        authority = CertificateAuthority.new(self.keys, days=400)
        for role in ("service", "camera", "operator", "viewer"):
            authority.add(role, role, "robot", days=365)
        self.port = free_port()
        self.endpoint = f"tls/127.0.0.1:{self.port}"
        self._temporary = folder / "tmp"
        self._temporary.mkdir()

    def start(self) -> None:
        """Start the service, and do not wait for it."""
        keys, state = str(self.keys / "service"), str(self._folder / "state")
        with (self._folder / "service.log").open("a") as log:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "ldo_service", "serve", "--endpoint", self.endpoint),
                    *("--keys", keys, "--state", state, *self._settings),
                ],
                stderr=log,
                env={**os.environ, "TMPDIR": str(self._temporary)},
            )

    def temporary_folders(self) -> int:
        """Return the number of temporary folders that the processes made and did not remove."""
        return len(list(self._temporary.glob("ldo-*")))

    def pids(self) -> set[int]:
        """Return the processes of the service."""
        found, new = set(), {self.process.pid}
        while new:
            found |= new
            new = set().union(*map(children_of, new)) - found
        return {pid for pid in found if _status(pid)}

    def sizes(self) -> dict[int, dict[str, float]]:
        """Return resident memory, open descriptors and threads of each process."""
        sizes = {}
        for pid in self.pids():
            with suppress(OSError):
                status, descriptors = _status(pid), len(os.listdir(f"/proc/{pid}/fd"))
                rss_mb, threads = int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"])
                sizes[pid] = {"rss_mb": rss_mb, "descriptors": descriptors, "threads": threads}
        return sizes

    def kill(self) -> None:
        """Send SIGKILL to all processes at once, as systemd does."""
        for pid in self.pids():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def connect(self, role: str, stack: ExitStack) -> Client:
        """Connect with the keys of a role, as soon as the service accepts it."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return stack.enter_context(connect("robot", self.endpoint, self.keys / role))
            except LdoError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(0.3)


def _status(pid: int) -> dict[str, str]:
    """Return the lines of /proc/PID/status by name; empty if the process has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return {}
    status = dict(line.split(":", 1) for line in lines)
    return status if "VmRSS" in status else {}


class Watch(Thread):
    """Thread that counts poses and keeps the last heartbeat of each process of an actor."""

    def __init__(self, client: Client, stack: ExitStack) -> None:
        super().__init__(daemon=True)
        self._healths = stack.enter_context(client.poller("health/*", Health))
        self._poses = stack.enter_context(client.poller("pose/tracked", TrackedPose))
        self._ended, self._lock = Event(), Lock()
        self.health: dict[str, Health] = {}
        self._by_process: dict[tuple[str, int], Health] = {}
        self._came_s: dict[str, float] = {}  # Time of the last heartbeat, by actor.
        self.statuses: Counter[str] = Counter()
        self.gap_s = self.ok_gap_s = 0.0
        self._pose_s = self.ok_s = time.monotonic()
        self.first_ok_s = 0.0  # Time of the first pose with status OK since `mark`; 0: none.
        self._marked_frame = 0

    def run(self) -> None:
        while not self._ended.wait(0.05):
            now_s = time.monotonic()
            with self._lock:
                for health in self._healths():
                    self.health[health.actor] = health
                    self._by_process[health.actor, health.pid] = health
                    self._came_s[health.actor] = now_s
                for pose in self._poses():
                    self._take(pose, now_s)
                self.gap_s = max(self.gap_s, now_s - self._pose_s)
                self.ok_gap_s = max(self.ok_gap_s, now_s - self.ok_s)

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()

    def _take(self, pose: TrackedPose, now_s: float) -> None:
        self.statuses[pose.status] += 1
        self._pose_s = now_s
        if pose.status == "OK":
            self.ok_s = now_s
            if pose.frame >= self._marked_frame:
                self.first_ok_s = self.first_ok_s or now_s

    def mark(self, frame: int) -> None:
        """Note the time of the next pose with status OK of this frame or a later one."""
        with self._lock:
            self.first_ok_s, self._marked_frame = 0.0, frame

    def state(self) -> dict[str, Any]:
        """Return the counts so far, silent actors and the size of the map."""
        with self._lock:
            healths, mapper = list(self._by_process.values()), self.health.get("mapper")
            now = {"poses": dict(self.statuses), "gap_s": self.gap_s, "ok_gap_s": self.ok_gap_s}
            silent = [name for name, at_s in self._came_s.items() if time.monotonic() > at_s + 3]
            quarantined = sum(health.quarantined for health in self.health.values())
        counts = {
            name: sum(getattr(health, name) for health in healths)
            for name in ("restarts", "failures", "dead_lettered")
        }
        counts["quarantined"] = quarantined
        counts["rejected"] = sum(one.rejected for health in healths for one in health.inputs)
        metrics = mapper.metrics if mapper else {}
        return {
            **now,
            **counts,
            "silent": silent,
            "mapper": {k: v for k, v in metrics.items() if k in SIZES},
        }


class Soak:
    """Faults, commands and samples of one run."""

    def __init__(self, folder: Path, out: Path, settings: Sequence[str], stack: ExitStack) -> None:
        self._stack, self._lines = stack, stack.enter_context(out.open("w"))
        self.service = Service(folder, settings)
        self.violations: list[str] = []
        self._started_s = time.monotonic()
        self._processes: set[int] = set()
        self._ended_by_fault: set[int] = set()
        self._releases: list[tuple[Timer, Callable[[], None]]] = []  # They end the faults.

    def run(self, duration_s: float, fault_every_s: float, without: Collection[str]) -> None:
        """Start the service and the camera, and inject faults for a time."""
        tour = open_sequence("synthetic:tour")
        there = [raw_frame_to_message(tour.read(i)) for i in range(0, len(tour), STRIDE)]
        self.service.start()
        self._stack.callback(self.service.kill)
        self.operator = self.service.connect("operator", self._stack)
        self.watch = Watch(self.operator, self._stack)
        self.watch.start()
        self._stack.callback(self.watch.stop)
        self.camera = CameraStream(and_back(there), RATE_HZ)
        self.camera.start(self.service.connect("camera", self._stack))
        self._stack.callback(self.camera.stop)
        self._started_s = time.monotonic()
        self._loop(duration_s, fault_every_s, [name for name in self.faults if name not in without])
        for timer, release in self._releases:
            if timer.is_alive():
                timer.cancel()
                release()

    def _loop(self, duration_s: float, fault_every_s: float, names: Sequence[str]) -> None:
        command_every_s = min(COMMAND_S, fault_every_s / 2)
        next_command_s, next_fault_s, next_sample_s = command_every_s / 2, fault_every_s, 0.0
        commands = faults = 0
        while (now_s := self._now_s()) < duration_s:
            if now_s >= next_sample_s:
                next_sample_s += SAMPLE_S
                self._sample()
            elif now_s >= next_fault_s:
                next_fault_s += fault_every_s
                self._fault(names[faults % len(names)])
                faults += 1
            elif now_s >= next_command_s:
                next_command_s += command_every_s
                self._command(COMMANDS[commands % len(COMMANDS)])
                commands += 1
            time.sleep(0.05)
        self._sample()

    def _now_s(self) -> float:
        return time.monotonic() - self._started_s

    def _write(self, kind: str, **what: Any) -> None:
        line = json.dumps({"kind": kind, "time_s": round(self._now_s(), 2), **what})
        print(line, file=self._lines, flush=True)

    def violation(self, what: str) -> None:
        """Note a violation, which makes the exit code 1."""
        self.violations.append(what)
        self._write("violation", what=what)

    def _sample(self) -> None:
        sizes = self.service.sizes()
        ended = self._processes - sizes.keys() - self._ended_by_fault
        if ended or self.service.process.poll() is not None:
            self.violation(
                f"processes {sorted(ended or {self.service.process.pid})} ended without a fault"
            )
        self._processes = set(sizes)
        total = {name: sum(size[name] for size in sizes.values()) for name in MEASURED}
        total["temporary_folders"] = self.service.temporary_folders()
        if total["temporary_folders"] > 1:
            self.violation(f"there are {total['temporary_folders']} temporary folders")
        main, sent = self.service.process.pid, self.camera.sent
        self._write("sample", **total, **self.watch.state(), main=main, processes=sizes, sent=sent)

    def _command(self, name: str) -> None:
        started_s = time.monotonic()
        try:
            answers = []
            if name == "refine":
                self.operator.refine(20)
            else:
                answers.append(self.operator.control(name))
            if name == "pause":
                time.sleep(PAUSE_S)
                answers.append(self.operator.control("resume"))
            refused = [answer.message for answer in answers if not answer.ok]
        except LdoError as error:
            refused = [str(error)]
        took_s = time.monotonic() - started_s - (PAUSE_S if name == "pause" else 0.0)
        self._write("command", name=name, took_s=round(took_s, 3), refused=refused)
        if refused:
            self.violation(f"{name} was refused: {refused}")

    # --- faults -----------------------------------------------------------------------------------
    def _fault(self, name: str) -> None:
        self.watch.mark(self.camera.sent)
        marked_s = time.monotonic()
        self._write("fault", name=name)
        self.faults[name](self)
        while not self.watch.first_ok_s and time.monotonic() < marked_s + PATIENCE_S:
            time.sleep(0.05)
        took_s = self.watch.first_ok_s - marked_s if self.watch.first_ok_s else None
        self._write("recovered", name=name, first_ok_s=took_s)

    def _release_after(self, duration_s: float, release: Callable[[], None]) -> None:
        """End a fault in time, even if a command waits for that end."""
        timer = Timer(duration_s, release)
        timer.daemon = True
        timer.start()
        self._releases.append((timer, release))

    def _kill_optimizer(self) -> None:
        pid = self.watch.health["optimizer"].pid
        self._ended_by_fault.add(pid)
        os.kill(pid, signal.SIGKILL)

    def _stop_optimizer(self) -> None:
        pid = self.watch.health["optimizer"].pid
        os.kill(pid, signal.SIGSTOP)

        def go_on() -> None:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

        self._release_after(STOP_S, go_on)

    def _kill_service(self) -> None:
        self._ended_by_fault |= self.service.pids()
        self.service.kill()
        time.sleep(SYSTEMD_PAUSE_S)
        self.service.start()

    def _idle_connections(self) -> None:
        held = []
        for _ in range(CONNECTIONS):
            with suppress(OSError):
                held.append(socket.create_connection(("127.0.0.1", self.service.port), 0.3))

        def close() -> None:
            for one in held:
                one.close()

        self._release_after(HELD_S, close)

    def _undecodable_frame(self) -> None:
        keys = TlsKeys.of(self.service.keys / "camera")
        network = Endpoint("robot", self.service.endpoint, keys)
        with open_session(network) as session:
            session.put(network.expression(CAMERA_RGBD.name), b"\xc1 is no message")
            time.sleep(1.0)

    def _stopped_reader(self) -> None:
        arguments = (self.service.endpoint, str(self.service.keys / "viewer"))
        reader = subprocess.Popen(
            [sys.executable, "-c", READER, *arguments], stdout=subprocess.PIPE, text=True
        )
        assert reader.stdout
        if reader.stdout.readline() != "reading\n":
            self.violation("a program could not read the map")
        reader.send_signal(signal.SIGSTOP)

        def end() -> None:
            reader.kill()
            reader.communicate()

        self._release_after(2 * HELD_S, end)

    faults = {
        "optimizer killed": _kill_optimizer,
        "optimizer stopped": _stop_optimizer,
        "service killed": _kill_service,
        "idle connections": _idle_connections,
        "undecodable frame": _undecodable_frame,
        "stopped reader": _stopped_reader,
    }


def run(
    out: Path,
    settings: Sequence[str],
    duration_s: float,
    fault_every_s: float,
    without: Collection[str] = (),
) -> bool:
    """Run the service, and return whether nothing was violated."""
    folder = Path(mkdtemp(prefix="ldo-soak-"))
    with ExitStack() as stack:
        soak = Soak(folder, out, settings, stack)
        soak.run(duration_s, fault_every_s, without)
        if soak.watch.gap_s > MAX_GAP_S:
            soak.violation(f"no pose came for {soak.watch.gap_s:.0f} s")
    if soak.violations:
        print(f"log and state: {folder}")
    else:
        shutil.rmtree(folder)
    return not soak.violations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="file for a JSON object per sample")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--fault-every-s", type=float, default=300.0)
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], help="setting of the service"
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        choices=list(Soak.faults),
        help="fault to leave out",
    )
    given = parser.parse_args()
    held = run(given.out, given.settings, 60 * given.minutes, given.fault_every_s, given.without)
    print(summary(read_lines(given.out)))
    raise SystemExit(not held)


if __name__ == "__main__":
    main()
