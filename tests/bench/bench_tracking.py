"""Our odometry compared with OpenCV, small_gicp and Open3D on the same frames, one thread each.

    python -m tests.bench.bench_tracking [SOURCE] [--frames N] [--stride N] [--json]
        [--without NAME ...]

SOURCE: a data set or synthetic sequence; default: tum/kitchen in LDO_DATA, else synthetic:tour.
ATE and RPE are those of `ldo eval`, over all frames, tracked or lost. `trusted` is the fraction of
frames that the method itself reports as tracked. Time is CPU ms per frame of the whole process,
without decoding. Each frame goes to all methods in turn, so that other load affects all equally.
`tracking_peers.py` describes each peer. `keyframe graph` has our frames on the pose-graph
optimizer's final keyframe poses.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.conversions.frames import frame_to_message
from ldo_service.conversions.poses import keyframe_poses_from_correction, pose_from_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import RgbdFrame, Trajectory
from ldo_service.kernels import isa
from ldo_service.schemas import Keyframe, TrackedPose
from ldo_service.tracking import Odometry, OdometryConfig, TrackingStatus
from ldo_service.tracking.window import WindowConfig
from tests.bench.tracking_peers import Step, peers

WARM_UP = 5  # First frames, which the times exclude.
OURS = "ours"
HEADER = """\
| | ATE RMSE cm | RPE 1 s cm | deg | trusted % | CPU ms p50 | p95 |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True, slots=True)
class Row:
    """Results of one method on one sequence."""

    method: str
    ate_cm: float
    rpe_cm: float | None
    rpe_deg: float | None
    trusted_percent: float | None = None
    cpu_ms_p50: float | None = None
    cpu_ms_p95: float | None = None

    @classmethod
    def of(cls, method: str, estimate: Trajectory, truth: Trajectory, **rest: float) -> "Row":
        errors = evaluate_trajectory(estimate, truth)
        shift, turn = errors.rpe_translation_m, errors.rpe_rotation_deg
        rpe_cm, rpe_deg = shift and 100 * shift.rmse, turn and turn.rmse
        return cls(method, 100 * errors.ate_m.rmse, rpe_cm, rpe_deg, **rest)

    def __str__(self) -> str:
        lengths = (self.ate_cm, self.rpe_cm, self.rpe_deg)
        others = (self.trusted_percent, self.cpu_ms_p50, self.cpu_ms_p95)
        figures = [(x, ".2f") for x in lengths] + [(x, ".1f") for x in others]
        cells = ("-" if x is None else f"{x:{form}}" for x, form in figures)
        return f"| {self.method} | " + " | ".join(cells) + " |"


@dataclass(slots=True)
class Runner:
    """Method with its results so far."""

    step: Step
    T_world_camera: list[np.ndarray] = field(default_factory=list)
    is_trusted: list[bool] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def take(self, frame: RgbdFrame) -> None:
        start_s = time.process_time()
        pose, is_trusted = self.step(frame)
        self.cpu_ms.append(1e3 * (time.process_time() - start_s))
        self.T_world_camera.append(np.array(pose))
        self.is_trusted.append(is_trusted)

    def row(self, method: str, stamps_s: np.ndarray, truth: Trajectory) -> Row:
        p50, p95 = np.percentile(self.cpu_ms[WARM_UP:], [50, 95])
        return Row.of(
            method,
            Trajectory(stamps_s, np.array(self.T_world_camera)),
            truth,
            trusted_percent=100 * float(np.mean(self.is_trusted)),
            cpu_ms_p50=float(p50),
            cpu_ms_p95=float(p95),
        )


def ours() -> Step:
    """Return our tracking as in the service, without the window measurements of the pose graph."""
    odometry = Odometry(OdometryConfig(window=WindowConfig(measurements=0)))

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        result = odometry.process(frame)
        return result.T_odom_camera, result.status is TrackingStatus.OK

    return step


def measure(
    sequence: Sequence, indices: range, methods: Iterable[tuple[str, Step]], truth: Trajectory
) -> list[Row]:
    runners = {name: Runner(step) for name, step in methods}
    for index in indices:
        frame = sequence[index]
        for runner in runners.values():
            runner.take(frame)
    stamps_s = sequence.stamps_ns[indices] * 1e-9
    return [runner.row(name, stamps_s, truth) for name, runner in runners.items()]


def corrected(sequence: Sequence, indices: range) -> Trajectory:
    """Return T_map_camera of our tracker's frames on the optimizer's last keyframe poses."""
    tracker, optimizer = Tracker(), Optimizer()
    poses: list[TrackedPose] = []
    T_map: dict[int, np.ndarray] = {}
    for index in indices:
        for message in tracker.handle(frame_to_message(sequence[index])):
            if isinstance(message, TrackedPose):
                poses.append(message)
                continue
            if isinstance(message, Keyframe):
                continue
            for correction in optimizer.handle(message):
                T_map = keyframe_poses_from_correction(correction)
                list(tracker.handle(correction))
    placed = [
        T_map[_reference(pose)] @ pose_from_message(pose.T_reference_camera) for pose in poses
    ]
    return Trajectory(np.array([pose.stamp_ns for pose in poses]) * 1e-9, np.array(placed))


def _reference(pose: TrackedPose) -> int:
    """Return the reference keyframe of a pose; the first keyframe refers to itself."""
    return pose.keyframe or 0 if pose.reference is None else pose.reference


def default_source() -> str:
    kitchen = Path(os.environ.get("LDO_DATA", "")) / "tum" / "kitchen"
    return str(kitchen) if kitchen.is_dir() else "synthetic:tour"


def on_one_thread() -> None:
    """Restart the program with one thread of OpenMP and BLAS, which read this when loaded."""
    if os.environ.get("OMP_NUM_THREADS") != "1":
        os.execve(
            sys.executable, [sys.executable, *sys.argv], os.environ | {"OMP_NUM_THREADS": "1"}
        )
    cv2.setNumThreads(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default=default_source())
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument(
        "--without", nargs="*", default=[], help="skip methods with this text in their name"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    on_one_thread()
    sequence = open_sequence(arguments.source)
    indices = range(len(sequence))[: arguments.frames : arguments.stride]
    truth = sequence.truth()
    if truth is None:
        parser.error(f"{sequence.name} has no ground truth to evaluate against.")
    chosen = [(OURS, ours())]
    for name, step in peers(sequence.camera):
        if not any(word in name for word in arguments.without):
            chosen.append((name, step))
    rows = measure(sequence, indices, chosen, truth)
    rows.insert(1, Row.of(f"{OURS}, keyframe graph", corrected(sequence, indices), truth))
    if arguments.json:
        print(
            json.dumps({"source": sequence.name, "rows": [asdict(row) for row in rows]}, indent=1)
        )
        return
    print(f"{sequence.name}, {len(indices)} frames, stride {arguments.stride}; {isa()}\n\n{HEADER}")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()
