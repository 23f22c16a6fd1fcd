"""Live service with messages that kill the process of the pose-graph optimizer.

    .venv/bin/python -m tests.faults.poison --minutes 20

The service has TLS keys and default settings, among them the restart budget. A camera sends frames
of 160x120 at 2 Hz. Once a minute, the measurements of a new keyframe become poison: the optimizer
sends SIGKILL to its own process whenever it handles them. The next message becomes poison only when
the previous one is quarantined. The exit code is 1 if a property is violated.
"""

import argparse
import shutil
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import mkdtemp

import msgspec

from ldo_service.runtime.quarantine import MAX_DELIVERIES, SUFFIX, QuarantinedMessage
from ldo_service.schemas import CameraRgbd, KeyframeMeasurements, TrackedPose, decode
from ldo_service.schemas.topics import KEYFRAME_MEASUREMENTS, POSE_TRACKED

from .camera import CameraStream, frames
from .message_recorder import MessageRecorder
from .service_process import NotRecovered, ServiceProcess

RATE_HZ = 2.0
POISON = "poison"  # File that `faulty_service` reads.
KILLED = "optimizer: its process was killed by signal 9"  # Log line of the service.


@dataclass
class Result:
    """Counts and violated properties of one run."""

    duration_s: float = 0.0
    sent: int = 0  # Frames of the camera.
    requested: int = 0  # Messages that were to become poison.
    poses: int = 0
    ok: set[int] = field(default_factory=set)  # Frames with a pose with status OK.
    ok_seconds: set[int] = field(default_factory=set)  # Seconds of the run with such a pose.
    gap_s: float = 0.0  # Longest time without such a pose.
    deliveries: dict[int, list[float]] = field(default_factory=dict)  # Times, by keyframe.
    quarantined: dict[int, tuple[int, float]] = field(default_factory=dict)  # Deliveries and time.
    counted: int = 0  # Quarantined messages in the heartbeat of the optimizer.
    restarts: int = 0  # Restarts of the process of the optimizer.
    ends: int = 0  # Times that the service ended.
    keyframes: set[int] = field(default_factory=set)
    placed: set[int] = field(default_factory=set)  # Keyframes in the pose graph.
    violations: list[str] = field(default_factory=list)

    @property
    def not_placed(self) -> set[int]:
        """Keyframes up to the newest known one that are not in the pose graph."""
        return set(range(max(self.keyframes | self.placed, default=-1) + 1)) - self.placed

    @property
    def ok_ratio(self) -> float:
        """Fraction of the seconds of the run in which a pose with status OK came."""
        return len(self.ok_seconds) / max(1, int(self.duration_s))

    def check(self) -> None:
        """Add the violated properties of a finished run."""
        unlike = {
            k: (len(times), self.quarantined.get(k, (0,))[0])
            for k, times in self.deliveries.items()
            if {len(times), self.quarantined.get(k, (0,))[0]} != {MAX_DELIVERIES}
        }
        missing = self.not_placed - self.deliveries.keys()
        for is_violated, what in (
            (self.ends, f"the service ended {self.ends} times"),
            (len(self.deliveries) != self.requested, "a request for poison found no keyframe"),
            (unlike, f"deliveries and saved deliveries differ from {MAX_DELIVERIES}: {unlike}"),
            (
                self.counted != len(self.deliveries),
                f"{self.counted} messages are quarantined instead of {len(self.deliveries)}",
            ),
            (missing, f"keyframes {sorted(missing)} are not in the pose graph"),
        ):
            if is_violated:
                self.violations.append(what)

    def summary(self) -> str:
        """Return the counts as text."""
        took_s = [self.quarantined[k][1] - self.deliveries[k][0] for k in self.quarantined]
        times = f"{median(took_s):.1f} s in the median, {max(took_s):.1f} s at most"
        each = sorted({len(times) for times in self.deliveries.values()})
        return "\n".join([
            f"{self.duration_s / 60:.1f} minutes, {self.sent} frames, {self.poses} poses, "
            f"{len(self.ok) / max(1, self.sent):.2%} of the frames and {self.ok_ratio:.2%} of the "
            f"seconds with a pose with status OK; at most {self.gap_s:.2f} s between two of them",
            f"{len(self.deliveries)} poison messages, deliveries of each: {each}; "
            f"{self.counted} quarantined, {times} after the first delivery",
            f"{self.restarts} restarts of the optimizer, {self.ends} ends of the service; "
            f"{len(self.keyframes)} keyframes, {len(self.placed)} of them in the pose graph",
            *(f"VIOLATED: {what}" for what in self.violations),
        ])  # fmt: skip


class PoisonRun:
    """Service, camera and the requests for poison."""

    def __init__(self, folder: Path, scene: Sequence[CameraRgbd], settings: Sequence[str]) -> None:
        self.folder, self.result, self.recorder = folder, Result(), MessageRecorder()
        self.service = ServiceProcess(folder, self.recorder, (*settings,), has_defaults=True)
        self.service.log = deque()  # It has no limit, because restarts are counted.
        self.camera = CameraStream(list(scene), RATE_HZ)

    def run(self, duration_s: float, every_s: float) -> Result:
        """Run the service for a time, and return the result."""
        result = self.result
        self.service.start()
        try:
            self.camera.start(self.service.client)
            self.service.wait("a keyframe is in the graph", lambda: self.recorder.placed)
            self._stream(duration_s, every_s)
            self.service.wait("the messages are quarantined", self._is_quarantined)
            poison = max(self.result.deliveries, default=-1)
            self.service.wait("a keyframe follows", lambda: max(self.recorder.keyframes) > poison)
            self.camera.stop()
            self.service.wait("all keyframes are handled", self._is_handled)
        except NotRecovered as error:
            result.violations.append(str(error))
        finally:
            self.camera.stop()
            self._count()
            if self.service.process.poll() is None and (code := self.service.stop()):
                result.violations.append(f"the stop ended with exit code {code}")
            self.service.close()
        result.violations += self.recorder.violations
        result.check()
        return result

    def _stream(self, duration_s: float, every_s: float) -> None:
        result, first, next_s = self.result, self.camera.sent, every_s / 2
        with self.service.client.poller(POSE_TRACKED.name, TrackedPose) as poses:
            started_s = ok_s = time.monotonic()
            while (now_s := time.monotonic()) < started_s + duration_s:
                self.recorder.update()
                for pose in poses():
                    result.poses += 1
                    if pose.status == "OK":
                        result.ok.add(pose.frame)
                        result.ok_seconds.add(int(now_s - started_s))
                        ok_s = now_s
                result.gap_s = max(result.gap_s, now_s - ok_s)
                if self.service.process.poll() is not None:
                    result.ends += 1
                    raise NotRecovered(f"the service ended:\n{self.service.tail()}")
                if now_s >= started_s + next_s and self._is_quarantined():
                    next_s += every_s
                    result.requested += 1
                    (self.folder / POISON).touch()
                time.sleep(0.05)
            result.duration_s = now_s - started_s
        result.sent = self.camera.sent - first

    def _is_quarantined(self) -> bool:
        """Return whether all requests found a keyframe, and these keyframes are quarantined."""
        self._count()
        return len(self.result.deliveries) == self.result.requested == self.result.counted

    def _is_handled(self) -> bool:
        """Return whether all keyframes but those of quarantined messages are in the pose graph.

        The subscriber may have missed keyframes. Their numbers are consecutive.
        """
        result = self.result
        return (
            self._is_quarantined()
            and result.not_placed == result.deliveries.keys()
            and max(result.placed) > max(result.deliveries, default=-1)
        )

    def _count(self) -> None:
        """Read the counts of the optimizer from its files, heartbeat, log and messages."""
        result, recorder = self.result, self.recorder
        result.deliveries = {
            int(path.name.removeprefix(f"{POISON}-")): list(map(float, path.read_text().split()))
            for path in self.folder.glob(f"{POISON}-*")
        }
        for path in (self.service.state / "state/optimizer.quarantine").glob(f"*{SUFFIX}"):
            saved = msgspec.msgpack.decode(path.read_bytes(), type=QuarantinedMessage)
            if saved.topic == KEYFRAME_MEASUREMENTS.name:
                keyframe = decode(saved.body, KeyframeMeasurements).keyframe
                result.quarantined[keyframe] = saved.deliveries, path.stat().st_mtime
        if "optimizer" in recorder.health:
            result.counted = recorder.health["optimizer"][1].quarantined
        result.restarts = sum(KILLED in line for line in self.service.log)
        result.keyframes, result.placed = set(recorder.keyframes), recorder.placed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--every-s", type=float, default=60.0, help="time between poison messages")
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], help="setting of the service"
    )
    given = parser.parse_args()
    folder = Path(mkdtemp(prefix="ldo-poison-"))
    result = PoisonRun(folder, frames(), given.settings).run(60 * given.minutes, given.every_s)
    print(result.summary())
    if result.violations:
        print(f"state: {folder}")
    else:
        shutil.rmtree(folder)
    raise SystemExit(bool(result.violations))


if __name__ == "__main__":
    main()
