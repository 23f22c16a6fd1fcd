"""Effect of a labeller with 5 s per call on a live service, and the accuracy of its labels.

    python -m tests.bench.bench_labeller [--delay-s 5] [--rates 2 6] [--seconds 30] [--rest-s 40]

`ldo serve` runs with the built-in detector in the synthetic flat at 320x240. A camera moves to and
fro through a part of it for `seconds` at each of the rates. Then it rests, and label results still
arrive. Each rate runs once without a labeller and once with one behind HTTP. After `delay-s` the
labeller returns the true object of an image under a name of its own; a region takes two calls.

The columns are:

- poses/s: poses with the status OK.
- latency: time from sending a frame to receiving its pose.
- ATE: error of the published T_map_camera, each frame at its own time.
- apart: maximum distance of T_odom_camera from the run without a labeller. Stamps differ a little,
  and keyframes differ where frames were dropped.
- late: keyframes between the label request of a region and its label result.
- right: fraction of the visible Gaussians with a name that lie on the named object.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from threading import Event, Thread

import msgspec
import numpy as np
import zenoh

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.conversions.poses import pose_from_message
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Trajectory
from ldo_service.schemas import CameraRgbd, TrackedPose, decode
from ldo_service.synthetic.flat import FlatSequence
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.detection.labellers.server import serving
from tests.service.conftest import LiveService, live_service
from tests.service.failure_artifacts import Guide, Placed, flat, placed
from tests.service.message_inbox import Heard

PART = range(120)  # Frames of the flat, sent forward and backward.
SETTINGS: tuple[str, ...] = ("detector.model=demo",)
HEADER = """\
| labeller | sent Hz | poses/s | latency ms p50 | p95 | dropped | ATE cm | apart mm | answers | \
late p50 | max | right % |
|---|---|---|---|---|---|---|---|---|---|---|---|"""


@dataclass
class Live:
    """Service with its received messages and the arrival times of its poses."""

    heard: Heard
    sent_ns: list[int] = field(default_factory=list)  # Index is the frame number.
    came_ns: dict[int, int] = field(default_factory=dict)

    def arrived(self, sample: zenoh.Sample) -> None:
        pose = decode(sample.payload.to_bytes(), TrackedPose)
        self.came_ns[pose.frame] = time.time_ns()

    def latencies_ms(self) -> np.ndarray:
        return np.array([1e-6 * (came - self.sent_ns[k]) for k, came in self.came_ns.items()])


class Camera:
    """Thread that sends frames, stamped with the time of sending."""

    def __init__(self, live: Live, tape: list[CameraRgbd], rate_hz: float) -> None:
        self._live, self._tape, self._rate_hz = live, tape, rate_hz
        self._stop = Event()
        self._thread = Thread(target=self._stream, daemon=True)

    def stream_for(self, seconds: float) -> None:
        self._thread.start()
        listen_for(self._live.heard, seconds)
        self._stop.set()
        self._thread.join()

    def _stream(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s += 1 / self._rate_hz
            number, stamp_ns = len(self._live.sent_ns), time.time_ns()
            self._live.sent_ns.append(stamp_ns)
            message = self._tape[number % len(self._tape)]
            frame = msgspec.structs.replace(message, frame=number, stamp_ns=stamp_ns)
            self._live.heard.service.client.send(frame)


def listen_for(heard: Heard, seconds: float) -> None:
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        heard.listen()
        time.sleep(0.05)


@dataclass(frozen=True)
class Scene:
    """Synthetic flat and the order in which a camera repeats its frames."""

    sequence: FlatSequence
    order: list[int]
    tape: list[CameraRgbd]

    @staticmethod
    def of(part: range) -> "Scene":
        sequence, order = flat(), [*part, *part[-2:0:-1]]
        messages = {index: raw_frame_to_message(sequence.read(index)) for index in part}
        return Scene(sequence, order, [messages[index] for index in order])

    def truth(self, frames: list[int], stamps_s: np.ndarray) -> Trajectory:
        indices = [self.order[frame % len(self.order)] for frame in frames]
        return Trajectory(stamps_s, self.sequence.truth().T_world_camera[indices])


@dataclass(frozen=True)
class Outcome:
    """Result of one run."""

    live: Live
    dropped: int  # Frames.
    lie: Placed | None  # Labels in the map.
    rate_hz: float
    seconds: float
    scene: Scene
    delay_s: float | None  # Seconds per call; None without a labeller.

    def T_odom_camera(self) -> dict[int, np.ndarray]:
        """Return T_odom_camera by frame."""
        return {pose.frame: pose_from_message(pose.T_odom_camera) for pose in self.live.heard.poses}

    def row(self, alone: "Outcome") -> str:
        poses = [p for p in self.live.heard.poses if p.status == "OK" and p.submap == 0]
        who = "none" if self.delay_s is None else f"{self.delay_s:g} s per call"
        p50, p95 = np.percentile(self.live.latencies_ms(), (50, 95))
        rate = f"{len(poses) / self.seconds:.1f}"
        frames, stamps_s = [p.frame for p in poses], np.array([1e-9 * p.stamp_ns for p in poses])
        T_map = np.array(
            [pose_from_message(p.T_map_odom) @ pose_from_message(p.T_odom_camera) for p in poses]
        )
        truth = self.scene.truth(frames, stamps_s)
        ate_m = evaluate_trajectory(Trajectory(stamps_s, T_map), truth).ate_m.rmse
        cells = [who, f"{self.rate_hz:g}", rate, f"{p50:.0f}", f"{p95:.0f}", str(self.dropped)]
        cells += [f"{100 * ate_m:.2f}", f"{1e3 * self._apart_m(alone):.3f}", *self._answers()]
        return f"| {' | '.join(cells)} |"

    def _apart_m(self, alone: "Outcome") -> float:
        ours, theirs = self.T_odom_camera(), alone.T_odom_camera()
        both = ours.keys() & theirs.keys()
        return max(float(np.linalg.norm(ours[k][:3, 3] - theirs[k][:3, 3])) for k in both)

    def _answers(self) -> Iterator[str]:
        heard = self.live.heard
        if self.lie is None or not heard.late:
            yield from "----"
            return
        yield f"{len(heard.answers)} of {len(heard.requests)}"
        yield f"{np.median(heard.late):.0f}"
        yield f"{max(heard.late)}"
        yield f"{100 * self.lie.share:.1f}, {len(self.lie.names)} objects"


def measured(
    scene: Scene, rate_hz: float, seconds: float, rest_s: float, delay_s: float | None
) -> Outcome:
    guide = Guide(scene.sequence, scene.order)

    def late(handler: BaseHTTPRequestHandler) -> None:
        handler.ended.wait(delay_s)  # type: ignore[attr-defined]
        guide(handler)

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="labeller-")))
        server = stack.enter_context(serving(late))
        settings = list(SETTINGS)
        if delay_s is not None:
            settings.append(f"vlm_labeller.url={server.url}")
        words = [word for setting in settings for word in ("--set", setting)]
        service: LiveService = stack.enter_context(live_service(folder, *words))
        service.wait_for_actors()
        live = Live(Heard(service, stack, guide))
        session = stack.enter_context(open_session(Endpoint("robot", service.endpoint)))
        handler = zenoh.handlers.Callback(live.arrived, indirect=False)
        stack.enter_context(session.declare_subscriber("ldo/robot/pose/tracked", handler))
        Camera(live, scene.tape, rate_hz).stream_for(seconds)
        listen_for(live.heard, rest_s if delay_s is not None else 3.0)
        lie = None if delay_s is None else where_names_lie(scene, live.heard)
        return Outcome(live, dropped(live.heard), lie, rate_hz, seconds, scene, delay_s)


def where_names_lie(scene: Scene, heard: Heard) -> Placed:
    first = scene.order[heard.frame_of[0] % len(scene.order)]
    return placed(*heard.map(), scene.sequence, first, PART[::6])


def dropped(heard: Heard) -> int:
    """Return the number of frames dropped or lost before the tracker."""
    inputs = heard.input("frame_source", "camera/rgbd"), heard.input("tracker", "frame/rgbd")
    return sum(count.dropped + count.lost for count in inputs)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--delay-s", type=float, default=5.0)
    parser.add_argument("--rates", type=float, nargs="+", default=[2.0, 6.0], metavar="HZ")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rest-s", type=float, default=40.0)
    arguments = parser.parse_args()
    scene = Scene.of(PART)
    print(HEADER, flush=True)
    for rate_hz in arguments.rates:
        times = rate_hz, arguments.seconds, arguments.rest_s
        alone = measured(scene, *times, None)
        print(alone.row(alone), flush=True)
        print(measured(scene, *times, arguments.delay_s).row(alone), flush=True)


if __name__ == "__main__":
    main()
