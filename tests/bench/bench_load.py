"""Robots and subscribers on one router of this machine, with more frames than can be tracked.

    python -m tests.bench.bench_load [--robots 1 4 16] [--minutes 10] [--subscribers 50]
    python -m tests.bench.bench_load --robots 1 --minutes 30 --times 0.8 --plot docs/soak.png
    python -m tests.bench.bench_load --robots 1 --minutes 1 --hz 3 --busy 2

Each robot is a service that connects to the router. It runs all its actors in one process, without
neural networks. Two mapping iterations per keyframe leave the CPU time to the runtime.

The camera of a robot first sends 30 Hz for half a minute, which gives the rate that the robot can
track. Then it sends --times that rate, and more if the robot tracked more in the last minute. With
--hz it sends this rate instead. --busy programs each occupy a core. A tenth of the subscribers is
slow and a tenth is stopped.

The output has the memory, the latency of all poses and the rate in thirds of the time. It also has
the number of frames that were tracked, dropped or lost.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock, Thread

import cv2
import msgspec
import numpy as np
import zenoh

from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError
from ldo_service.schemas import CameraRgbd, Health, TrackedPose, decode
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.faults.camera import frames
from tests.ports import free_endpoint

# A robot has one process.
LIGHT = ("mapper.iterations=2", "mapper.threads=1", "service.process_actors=[]")
SAMPLE_S = 2.0
RECENT = 30  # Samples in a minute.
SETTLE_S = 30.0  # Time to find the rate that a robot can track.
QUICK_IN_ONE_PROCESS = 8
ACTORS = 7


@dataclass
class Robot:
    """Service with its camera and the measurements of both."""

    name: str
    process: subprocess.Popen[bytes]
    client: Client
    sent: int = 0
    since_ns: int = 0  # Earlier frames do not count; they only serve to choose the frame rate.
    poses: int = 0
    judged: int = 0  # Poses that count; judged_ok of them have the status OK.
    judged_ok: int = 0
    latest_ms: list[float] = field(default_factory=list)  # Since the last sample.
    latencies_ms: list[list[float]] = field(default_factory=list)  # Latencies by sample.
    health: dict[str, Health] = field(default_factory=dict)
    samples: list[tuple[float, float, float, float]] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)

    def sample(self, elapsed_s: float, span_s: float) -> None:
        """Add a sample: time in s, resident MB, median latency in ms, and poses per second."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        with self.lock:
            latest, self.latest_ms = self.latest_ms, []
        median_ms = float(np.median(latest)) if latest else float("nan")
        rss_mb = pages * os.sysconf("SC_PAGESIZE") / 1e6
        self.samples.append((elapsed_s, rss_mb, median_ms, len(latest) / span_s))
        self.latencies_ms.append(latest)

    def published(self) -> int:
        """Return how many poses the tracker has sent by its own count."""
        (poses,) = [o for o in self.health["tracker"].outputs if o.topic == "pose/tracked"]
        return poses.sent

    def heard(self, sample: zenoh.Sample) -> None:
        pose = decode(sample.payload.to_bytes(), TrackedPose)
        with self.lock:
            self.poses += 1
            if pose.stamp_ns < self.since_ns:
                return
            self.judged += 1
            self.judged_ok += pose.status == "OK"
            self.latest_ms.append(1e-6 * (time.time_ns() - pose.stamp_ns))

    def reported(self, sample: zenoh.Sample) -> None:
        health = decode(sample.payload.to_bytes(), Health)
        self.health[health.actor] = health


class Camera:
    """Thread that sends `rate_hz` frames to a robot, stamped with the time of sending."""

    def __init__(self, robot: Robot, scene: list[CameraRgbd], rate_hz: float) -> None:
        self._robot, self._scene, self.rate_hz = robot, scene, rate_hz
        self._stop = Event()
        self._thread = Thread(target=self._stream, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _stream(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + 1 / self.rate_hz, time.monotonic() - 1.0)
            frame = self._scene[self._robot.sent % len(self._scene)]
            number, stamp_ns = self._robot.sent, time.time_ns()
            self._robot.client.send(msgspec.structs.replace(frame, frame=number, stamp_ns=stamp_ns))
            self._robot.sent += 1


# --- robots and subscribers -----------------------------------------------------------------------
@contextmanager
def robots_on(
    network: Endpoint, count: int, folder: Path, settings: tuple[str, ...]
) -> Iterator[list[Robot]]:
    with ExitStack() as stack:
        endpoint = network.endpoint
        robots = [_robot(f"robot{i}", endpoint, folder, settings, stack) for i in range(count)]
        until_s = time.monotonic() + 60 + 20 * count
        while any(len(robot.health) < ACTORS for robot in robots):
            if time.monotonic() > until_s:
                raise TimeoutError("not all actors sent a health message in time")
            time.sleep(0.2)
        yield robots


def _robot(
    name: str, endpoint: str, folder: Path, settings: tuple[str, ...], stack: ExitStack
) -> Robot:
    words = [word for setting in (*LIGHT, *settings) for word in ("--set", setting)]
    command = [sys.executable, "-m", "ldo_service", "serve", "--client", "--robot", name]
    process = subprocess.Popen(
        [*command, "--endpoint", endpoint, "--state", str(folder / name), *words],
        stderr=(folder / f"{name}.log").open("w"),
    )
    stack.callback(_end, process)
    robot = Robot(name, process, stack.enter_context(connect(name, endpoint)))
    session = stack.enter_context(open_session(Endpoint(name, endpoint)))
    for topic, heard in (("pose/tracked", robot.heard), ("health/*", robot.reported)):
        handler = zenoh.handlers.Callback(heard, indirect=False)
        stack.enter_context(session.declare_subscriber(f"ldo/{name}/{topic}", handler))
    return robot


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(60)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class Crowd:
    """Subscribers in processes of their own: quick, slow and stopped ones."""

    def __init__(self, endpoint: str, count: int, stack: ExitStack) -> None:
        slow = dead = count // 10
        quick = count - slow - dead
        sizes = [quick // QUICK_IN_ONE_PROCESS] * QUICK_IN_ONE_PROCESS
        sizes[0] += quick - sum(sizes)
        self._quick = [self._start(endpoint, n, "quick", stack) for n in sizes if n]
        if slow:
            self._start(endpoint, slow, "slow", stack)
            os.kill(self._start(endpoint, dead, "dead", stack).pid, signal.SIGSTOP)

    def _start(
        self, endpoint: str, count: int, kind: str, stack: ExitStack
    ) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.load_listeners", endpoint, str(count), kind],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        assert process.stdout
        if process.stdout.readline().strip() != "ready":
            raise ConfigError(f"{count} {kind} subscribers could not connect")
        return process

    def poses(self) -> list[int]:
        """End the quick subscribers and return how many poses each received."""
        replies = [json.loads(process.communicate(timeout=60)[0]) for process in self._quick]
        return [counts["ldo/*/pose/tracked"] for of_one in replies for counts in of_one]


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Run programs that occupy a core each."""
    with ExitStack() as stack:
        for _ in range(count):
            program = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(program.wait)
            stack.callback(program.kill)
        yield


# --- one run --------------------------------------------------------------------------------------
@dataclass
class Outcome:
    robots: list[Robot]


def loaded(
    count: int,
    subscribers: int,
    minutes: float,
    times: float,
    hz: float | None,
    settings: tuple[str, ...],
    scene: list[CameraRgbd],
) -> Outcome:
    with ExitStack() as stack:
        network = Endpoint("router", free_endpoint())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="load-")))
        stack.enter_context(open_session(network, router=True))
        robots = stack.enter_context(robots_on(network, count, folder, settings))
        rate_hz = hz or times * _sustained(robots, scene)
        print(f"{count} robots receive {rate_hz:.1f} Hz each", flush=True)
        crowd = Crowd(network.endpoint, subscribers, stack)
        before = sum(robot.published() for robot in robots)
        cameras = [Camera(robot, scene, rate_hz) for robot in robots]
        started_s = last_s = time.monotonic()
        while (now_s := time.monotonic()) < started_s + 60 * minutes:
            time.sleep(max(0.0, last_s + SAMPLE_S - now_s))
            now_s = time.monotonic()
            for robot, camera in zip(robots, cameras, strict=True):
                robot.sample(now_s - started_s, now_s - last_s)
                if not hz and len(robot.samples) >= RECENT:
                    tracked_hz = float(np.mean([s[3] for s in robot.samples[-RECENT:]]))
                    camera.rate_hz = max(camera.rate_hz, times * tracked_hz)
            last_s = now_s
        for camera in cameras:
            camera.stop()
        _settle(robots)
        heard = crowd.poses()
        published = sum(robot.published() for robot in robots) - before
        rates = sorted(camera.rate_hz for camera in cameras)
        print(f"poses published {published}, received by quick subscribers {sorted(heard)}")
        print(f"sent at the end, Hz: {rates[0]:.1f} to {rates[-1]:.1f}")
        return Outcome(robots)


def _sustained(robots: list[Robot], scene: list[CameraRgbd]) -> float:
    """Return the poses per second and robot when frames arrive faster than they are tracked."""
    cameras = [Camera(robot, scene, 30.0) for robot in robots]
    time.sleep(SETTLE_S / 2)
    before, started_s = sum(robot.poses for robot in robots), time.monotonic()
    time.sleep(SETTLE_S / 2)
    made, took_s = sum(robot.poses for robot in robots) - before, time.monotonic() - started_s
    for camera in cameras:
        camera.stop()
    _settle(robots)
    for robot in robots:
        robot.since_ns = time.time_ns()
        robot.samples.clear()
        robot.latest_ms.clear()
        robot.latencies_ms.clear()
    return max(0.2, made / took_s / len(robots))


def _settle(robots: list[Robot]) -> None:
    """Wait until all queues are empty and heartbeats have reported it."""
    time.sleep(3.0)
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s and any(
        count.queued for robot in robots for h in robot.health.values() for count in h.inputs
    ):
        time.sleep(0.5)
    time.sleep(2.0)


# --- results --------------------------------------------------------------------------------------
def accounts(robot: Robot) -> dict[str, int]:
    """Return how many frames of a robot were sent, tracked, dropped and lost."""
    (camera,) = [i for i in robot.health["frame_source"].inputs if i.topic == "camera/rgbd"]
    (made,) = [o for o in robot.health["frame_source"].outputs if o.topic == "frame/rgbd"]
    (taken,) = [i for i in robot.health["tracker"].inputs if i.topic == "frame/rgbd"]
    return {
        "sent": robot.sent,
        "received": camera.delivered,
        "dropped": camera.dropped,
        "lost to the frame source": camera.lost,
        "unaccounted for": robot.sent - camera.delivered - camera.dropped - camera.lost,
        "forwarded": made.sent,
        "tracked": taken.delivered,
        "dropped by the tracker": taken.dropped,
        "lost to the tracker": taken.lost,
        "forwarded and unaccounted for": made.sent - taken.delivered - taken.dropped - taken.lost,
    }


def table(outcome: Outcome) -> str:
    """Return the table of all robots together, in thirds of the time."""
    samples = np.array([robot.samples for robot in outcome.robots])  # [R, S, 4]
    head = (
        "third",
        "max memory of a service MB",
        "pose latency ms p50 / p95 / max",
        "poses/s per robot",
    )
    lines = [f"| {' | '.join(head)} |", "|---|---|---|---|"]
    for number, which in enumerate(np.array_split(np.arange(samples.shape[1]), 3), 1):
        third = samples[:, which]
        latencies = [ms for robot in outcome.robots for k in which for ms in robot.latencies_ms[k]]
        p50, p95, most = np.percentile(latencies or [np.nan], (50, 95, 100))
        lines.append(
            f"| {number} | {third[..., 1].max():.0f} | {p50:.0f} / {p95:.0f} / {most:.0f} | "
            f"{third[..., 3].mean():.2f} |"
        )
    counted = [accounts(robot) for robot in outcome.robots]
    total = {name: sum(one[name] for one in counted) for name in counted[0]}
    facts = [robot.health["mapper"].metrics for robot in outcome.robots]
    total |= {name: round(sum(one[name] for one in facts)) for name in ("keyframes", "gaussians")}
    total["poses"] = sum(robot.judged for robot in outcome.robots)
    total["of them OK"] = sum(robot.judged_ok for robot in outcome.robots)
    return "\n".join([*lines, "", ", ".join(f"{name} {n}" for name, n in total.items())])


WIDTH, HEIGHT, LEFT = 640, 130, 70


def plot(robot: Robot) -> np.ndarray:
    """Return an image of memory, latency and rate over time."""
    samples = np.array(robot.samples)
    names = ("memory, MB", "pose latency, ms", "poses per second")
    panels = [
        _panel(samples[:, 0] / 60, samples[:, k], name) for k, name in enumerate(names, start=1)
    ]
    return np.vstack(panels)


def _panel(minutes: np.ndarray, values: np.ndarray, name: str) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    known = np.isfinite(values)
    top = 1.1 * max(float(values[known].max(initial=0.0)), 1e-9)
    x = LEFT + (WIDTH - LEFT - 15) * minutes[known] / max(float(minutes.max()), 1e-9)
    y = (HEIGHT - 22) - (HEIGHT - 50) * values[known] / top
    line = np.stack([x, y], axis=1).round().astype(np.int32)
    cv2.line(image, (LEFT, HEIGHT - 22), (WIDTH - 15, HEIGHT - 22), (200, 200, 200), 1)
    cv2.polylines(image, [line.reshape(-1, 1, 2)], False, (31, 111, 235), 1, cv2.LINE_AA)
    for text, where in (
        (name, (LEFT, 18)),
        (f"{top / 1.1:.4g}", (8, HEIGHT - 22 - round((HEIGHT - 50) / 1.1))),
        ("0", (8, HEIGHT - 20)),
        (f"{minutes.max():.0f} min", (WIDTH - 65, HEIGHT - 6)),
    ):
        cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1)
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--subscribers", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=10.0)
    rate = parser.add_mutually_exclusive_group()
    rate.add_argument(
        "--times", type=float, default=2.0, help="factor of the rate that a robot can track"
    )
    rate.add_argument("--hz", type=float, help="rate of the frames sent to each robot")
    parser.add_argument(
        "--busy", type=int, default=0, help="number of programs that occupy a core each"
    )
    parser.add_argument(
        "--set", nargs="+", default=[], help="settings of each service, as for `ldo serve`"
    )
    parser.add_argument("--plot", type=Path, help="PNG file of the first robot's curves")
    arguments = parser.parse_args()
    scene = frames()
    for count in arguments.robots:
        with busy(arguments.busy):
            outcome = loaded(
                count,
                arguments.subscribers,
                arguments.minutes,
                arguments.times,
                arguments.hz,
                tuple(arguments.set),
                scene,
            )
        print(table(outcome), flush=True)
        if arguments.plot:
            cv2.imwrite(str(arguments.plot), plot(outcome.robots[0])[..., ::-1])


if __name__ == "__main__":
    main()
