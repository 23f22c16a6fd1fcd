"""Rates of poses and keyframes of a live service whose back ends are slow, and their recovery.

    python -m tests.bench.bench_backends [--source DIR] [--seconds 100] [--hz 2] [--pairs 3]
                                         [--only nothing optimizer ...] [--replay] [--json FILE]

Each run starts a service with all actors, sends the frames of a recorded walk at a fixed rate, and
counts poses, poses with status OK and mapped keyframes in a window after a warm-up. Then the back
ends become fast, and the run waits until no actor is behind. The output compares the rates, the
closures, the object names and the keyframe poses with those of the run without a slow back end.
The row "again" is a second run without a slow back end: it differs by timing alone.
With --replay each run is recorded, and its replay must give the same messages bit for bit.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from ldo_service.client import Client, connect
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.conversions.poses import keyframe_poses_from_correction
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.errors import ConfigError
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import se3
from ldo_service.geometry.trajectory import Trajectory
from ldo_service.schemas import GraphCorrection, Health, MapObject, MapObjects, TrackedPose, decode
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.bench.bench_late_labels import matched
from tests.ports import free_endpoint

PROGRAM = Path(__file__).with_name("slow_service.py")
SLOW_BACKENDS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "again": {},
    "optimizer": {"optimizer": 4.0},
    "loop_closer": {"loop_closer": 3.0},
    "detector": {"detector": 2.0},
    "vlm_labeller": {"vlm_labeller": 5.0},
    "all": {"optimizer": 4.0, "loop_closer": 3.0, "detector": 2.0, "vlm_labeller": 5.0},
    "solve": {"optimizer": {"hold_gil_once": 60}},
    "suspended": {},
}
SUSPENDED_S = 60.0
WARM_UP_S = 10.0
RECOVERY_S = 600.0  # Time limit for the back ends to catch up.


@dataclass
class Result:
    """Measurements of one run; rates are per second of the window."""

    slowed: str
    poses_per_s: float = 0.0
    ok_per_s: float = 0.0
    keyframes_per_s: float = 0.0
    max_behind: dict[str, int] = field(default_factory=dict)
    recovery_s: float = float("nan")
    restarts: dict[str, int] = field(default_factory=dict)
    dropped: int = 0
    keyframes: int = 0
    closures: list[tuple[int, int]] = field(default_factory=list)
    objects: tuple[MapObject, ...] = ()
    labelled: int = 0
    # Centers of the keyframes in the map, meters, by stamp in ns.
    camera_m: dict[int, list[float]] = field(default_factory=dict)
    ate_cm: float = float("nan")
    replayed: bool | None = None  # The replay was bitwise equal; None without a replay.


class Monitor:
    """Subscriber that counts the poses and keeps the newest health, graph and objects."""

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        self.poses: list[tuple[float, str]] = []
        self.stamps_ns: dict[int, int] = {}  # Stamp of each keyframe.
        self.health: dict[str, Health] = {}
        self.pids: dict[str, set[int]] = {}
        self.graph: GraphCorrection | None = None
        self.objects: MapObjects | None = None
        self.refined_s = float("nan")  # Time of the wait until no refinement was pending.
        kinds = {"pose/tracked": TrackedPose, "graph/correction": GraphCorrection,
                 "map/objects": MapObjects, "health/*": Health}  # fmt: skip
        self._subscribers = [
            session.declare_subscriber(
                network.expression(topic),
                zenoh.handlers.Callback(
                    self._taker(kind),
                    indirect=False,
                ),
            )
            for topic, kind in kinds.items()
        ]

    def _taker(self, kind: type[Any]) -> Callable[[zenoh.Sample], None]:
        return lambda sample: self._take(decode(sample.payload.to_bytes(), kind))

    def _take(self, message: TrackedPose | GraphCorrection | MapObjects | Health) -> None:
        match message:
            case TrackedPose():
                self.poses.append((time.monotonic(), message.status))
                if message.keyframe is not None:
                    self.stamps_ns[message.keyframe] = message.stamp_ns
            case GraphCorrection():
                self.graph = message
            case MapObjects():
                self.objects = message
            case Health():
                self.health[message.actor] = message
                self.pids.setdefault(message.actor, set()).add(message.pid)

    def behind(self) -> dict[str, int]:
        """Return the largest number of unhandled messages of each consumer with a backlog."""
        behind: dict[str, int] = {}
        for health in list(self.health.values()):
            for output in health.outputs:
                for consumer, count in output.behind.items():
                    behind[consumer] = max(behind.get(consumer, 0), count)
        return behind

    def is_refined(self) -> bool:
        """Return whether the mapper has handled all keyframes and has no pending iterations."""
        health = self.health["mapper"]
        queued = sum(i.queued for i in health.inputs)
        return not (queued or health.metrics.get("iterations_pending", 0))

    def is_settled(self) -> bool:
        """Return whether every message was handled and no work is pending."""
        healths = list(self.health.values())
        queued = sum(i.queued for health in healths for i in health.inputs)
        busy = any(health.current_step_s > 0 for health in healths)
        kinds = "label_requests_pending", "keyframes_to_relabel", "iterations_pending"
        pending = sum(self.health["mapper"].metrics.get(kind, 0) for kind in kinds)
        return not (sum(self.behind().values()) or queued or busy or pending)

    def mapped(self) -> int:
        (count,) = [i for i in self.health["mapper"].inputs if i.topic == "keyframe/new"]
        return count.delivered


def run(slowed: str, sequence: Sequence, options: argparse.Namespace) -> Result:
    """Run one service, replay its recording if that was asked for, and return the measurements."""
    with tempfile.TemporaryDirectory() as folder:
        result = run_service(slowed, sequence, options, Path(folder))
        if options.replay:
            command = ["-m", "ldo_service", "replay", f"{folder}/recording", "--verify"]
            replay = subprocess.run([sys.executable, *command], capture_output=True, text=True)
            result.replayed = replay.returncode == 0
            if not result.replayed:
                print(replay.stdout + replay.stderr, file=sys.stderr)
    return result


def run_service(
    slowed: str, sequence: Sequence, options: argparse.Namespace, folder: Path
) -> Result:
    result, seconds = Result(slowed), options.seconds
    words = [word for setting in options.settings for word in ("--set", setting)]
    if options.replay:
        words += ["--record", str(folder / "recording")]
    with ExitStack() as stack:
        network = Endpoint("robot", free_endpoint())
        process = subprocess.Popen(
            [sys.executable, str(PROGRAM), "serve", "--endpoint", network.endpoint,
             "--state", str(folder / "state"), *words],
            env={**os.environ, "SLOW": json.dumps(SLOW_BACKENDS[slowed]),
                 "RECOVERED": str(folder / "recovered")},
            stderr=(folder / "log").open("wb"),
        )  # fmt: skip
        stack.callback(lambda: (process.send_signal(signal.SIGINT), process.wait(120)))
        client = connect_patiently(stack, network, process, folder / "log")
        session = stack.enter_context(open_session(network))
        monitor = Monitor(session, network)
        assert client.wait_for_subscriber(60)
        wait_for_actors(monitor)
        stop = threading.Event()
        camera = threading.Thread(target=stream, args=(client, sequence, options.hz, stop))
        camera.start()
        stack.callback(stop.set)
        time.sleep(WARM_UP_S)
        pid = max(monitor.pids["optimizer"])
        if slowed == "suspended":
            os.kill(pid, signal.SIGSTOP)
            threading.Timer(SUSPENDED_S, os.kill, (pid, signal.SIGCONT)).start()
        started_s, mapped = time.monotonic(), monitor.mapped()
        while time.monotonic() < started_s + seconds:
            time.sleep(1.0)
            for name, count in monitor.behind().items():
                result.max_behind[name] = max(count, result.max_behind.get(name, 0))
        window = [status for at_s, status in monitor.poses if at_s >= started_s]
        result.poses_per_s = len(window) / seconds
        result.ok_per_s = window.count("OK") / seconds
        result.keyframes_per_s = (monitor.mapped() - mapped) / seconds
        stop.set()
        camera.join()
        (folder / "recovered").touch()
        result.recovery_s = wait_until_settled(monitor)
        result.restarts = {name: len(pids) - 1 for name, pids in monitor.pids.items()}
        result.dropped = sum(o.backlog_dropped for h in monitor.health.values() for o in h.outputs)
        read_outcome(monitor, result, sequence)
        if process.poll() is not None:
            raise SystemExit((folder / "log").read_text()[-3000:])
    return result


def connect_patiently(
    stack: ExitStack, network: Endpoint, process: subprocess.Popen[bytes], log: Path
) -> Client:
    for _ in range(120):
        try:
            return stack.enter_context(connect(network.robot, network.endpoint))
        except ConfigError:  # The router of the service is not open yet.
            if process.poll() is not None:
                raise SystemExit(log.read_text()[-3000:]) from None
            time.sleep(0.5)
    raise SystemExit(f"the service at {network.endpoint} did not answer")


def wait_for_actors(monitor: Monitor) -> None:
    """Wait until the mapper and all back ends have started."""
    for _ in range(240):
        if {"mapper", *SLOW_BACKENDS["all"]} <= monitor.health.keys():
            return
        time.sleep(0.5)
    raise SystemExit(
        f"mapper or back ends have not started; actors that started: {sorted(monitor.health)}"
    )


def stream(client: Client, sequence: Sequence, hz: float, stop: threading.Event) -> None:
    """Send the frames of a sequence at a rate, with stamps of that rate."""
    due_s = time.monotonic()
    for index in range(len(sequence)):
        if stop.wait(max(0.0, due_s - time.monotonic())):
            return
        due_s += 1.0 / hz
        client.send(raw_frame_to_message(sequence.read(index), compress_depth=True))


def wait_until_settled(monitor: Monitor) -> float:
    started_s, quiet = time.monotonic(), 0
    while quiet < 6:
        if time.monotonic() > started_s + RECOVERY_S:
            return float("nan")
        time.sleep(0.5)
        quiet = quiet + 1 if monitor.is_settled() else 0
        if np.isnan(monitor.refined_s) and monitor.is_refined():
            monitor.refined_s = time.monotonic() - started_s
    return time.monotonic() - started_s


def read_outcome(monitor: Monitor, result: Result, sequence: Sequence) -> None:
    graph = monitor.graph
    assert graph is not None
    poses = keyframe_poses_from_correction(graph)
    result.keyframes = len(poses)
    stamps_ns = monitor.stamps_ns
    result.camera_m = {stamps_ns[k]: T[:3, 3].tolist() for k, T in poses.items() if k in stamps_ns}
    result.closures = sorted((stamps_ns[a], stamps_ns[b]) for a, b in graph.accepted_closures)
    truth = sequence.truth()
    if truth is not None:
        placed = sorted(result.camera_m.items())
        T = np.tile(np.eye(4), (len(placed), 1, 1))
        T[:, :3, 3] = [center for _, center in placed]
        estimate = Trajectory(np.array([stamp_ns for stamp_ns, _ in placed]) * 1e-9, T)
        result.ate_cm = 100 * evaluate_trajectory(estimate, truth).ate_m.rmse
    result.objects = monitor.objects.objects if monitor.objects else ()
    result.labelled = int(monitor.health["vlm_labeller"].metrics.get("regions_named", 0))


def rmse_cm(one: Result, other: Result) -> float:
    """Return the RMSE between the keyframe centers of two runs after their alignment, cm."""
    common = sorted(one.camera_m.keys() & other.camera_m.keys())
    a = np.array([one.camera_m[k] for k in common])
    b = np.array([other.camera_m[k] for k in common])
    T = se3.fit_rigid_transform(a, b)
    off = se3.transform(T, a) - b
    return 100 * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    data = Path(os.environ.get("LDO_DATA", "."))
    parser.add_argument("--source", default=str(data / "replica" / "apartment_floor1"))
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--pairs", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(SLOW_BACKENDS), choices=SLOW_BACKENDS)
    parser.add_argument("--set", nargs="+", default=[], dest="settings")
    parser.add_argument("--replay", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sequence = open_sequence(options.source)
    results: list[Result] = []
    print("slowed        poses/s  OK/s  keyframes/s  behind  recovery s  closures  objects", end="")
    print("  matched  vs cm")
    for _ in range(options.pairs):
        reference: Result | None = None
        for slowed in dict.fromkeys(("nothing", *options.only)):
            result = run(slowed, sequence, options)
            results.append(result)
            reference = reference or result
            print(
                f"{slowed:13} {result.poses_per_s:7.2f} {result.ok_per_s:5.2f} "
                f"{result.keyframes_per_s:11.2f} {max(result.max_behind.values(), default=0):7d} "
                f"{result.recovery_s:10.0f}  {len(result.closures):8d} "
                f"{len(result.objects):8d} {matched(result.objects, reference.objects):8d} "
                f"{rmse_cm(result, reference):6.2f}  "
                f"restarts {sum(result.restarts.values())} dropped {result.dropped} "
                f"labelled {result.labelled} ate {result.ate_cm:.2f} cm "
                f"replay {result.replayed}",
                flush=True,
            )
    if options.json:
        options.json.write_bytes(msgspec.json.encode(results))


if __name__ == "__main__":
    main()
