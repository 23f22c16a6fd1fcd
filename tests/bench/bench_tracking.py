"""Our odometry beside OpenCV's, small_gicp's and Open3D's, on the same frames, one thread each.

    python tests/bench/bench_tracking.py [SOURCE] [--frames N] [--stride N] [--json]
        [--without NAME ...]

SOURCE: a data set or synthetic sequence; default: tum/kitchen in LDO_DATA, else synthetic:tour.
ATE and RPE as `ldo eval` has them, over all frames, found or not. Trusted: what the method itself
says of a frame. Time: CPU ms per frame of the whole process, decoding excluded; each frame is
given to all methods in turn, so other load on the machine meets all alike. `tracking_peers.py`
says what each peer is.
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
from tracking_peers import Step, peers

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import RgbdFrame, Trajectory
from ldo_service.kernels import isa
from ldo_service.tracking import Odometry, Status

WARM_UP = 5  # frames left out of the times
OURS = "ours"
HEADER = """\
| | ATE RMSE cm | RPE 1 s cm | deg | trusted % | CPU ms p50 | p95 |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True, slots=True)
class Row:
    """One method over one sequence."""

    method: str
    ate_cm: float
    rpe_cm: float | None
    rpe_deg: float | None
    trusted_percent: float
    cpu_ms_p50: float
    cpu_ms_p95: float

    def __str__(self) -> str:
        rpe_cm, rpe_deg = ("-" if x is None else f"{x:.2f}" for x in (self.rpe_cm, self.rpe_deg))
        return (
            f"| {self.method} | {self.ate_cm:.2f} | {rpe_cm} | {rpe_deg} | "
            f"{self.trusted_percent:.1f} | {self.cpu_ms_p50:.1f} | {self.cpu_ms_p95:.1f} |"
        )


@dataclass(slots=True)
class Runner:
    """A method, and what it gave so far."""

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
        errors = evaluate_trajectory(Trajectory(stamps_s, np.array(self.T_world_camera)), truth)
        shift, turn = errors.rpe_translation_m, errors.rpe_rotation_deg
        return Row(
            method,
            100 * errors.ate_m.rmse,
            100 * shift.rmse if shift else None,
            turn.rmse if turn else None,
            100 * float(np.mean(self.is_trusted)),
            *(float(p) for p in np.percentile(self.cpu_ms[WARM_UP:], [50, 95])),
        )


def ours() -> Step:
    """As the service's tracker: references and supporting keyframes, all of them with room."""
    odometry = Odometry()

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        tracked = odometry.track(frame)
        if tracked.wants_keyframe:
            odometry.make_keyframe(frame, tracked)
        elif tracked.wants_mapping:
            odometry.make_supporting(tracked)
        return tracked.T_odom_camera, tracked.status is Status.OK

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


def default_source() -> str:
    kitchen = Path(os.environ.get("LDO_DATA", "")) / "tum" / "kitchen"
    return str(kitchen) if kitchen.is_dir() else "synthetic:tour"


def on_one_thread() -> None:
    """Start anew with one thread of OpenMP and BLAS, which read this when they are loaded."""
    if os.environ.get("OMP_NUM_THREADS") != "1":
        os.execve(
            sys.executable, [sys.executable, *sys.argv], os.environ | {"OMP_NUM_THREADS": "1"}
        )
    cv2.setNumThreads(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="?", default=default_source())
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--without", nargs="*", default=[], help="leave out methods named so")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    on_one_thread()
    sequence = open_sequence(arguments.source)
    indices = range(len(sequence))[: arguments.frames : arguments.stride]
    truth = sequence.truth()
    if truth is None:
        parser.error(f"{sequence.name} has no ground truth: nothing to compare with.")
    chosen = [(OURS, ours())]
    for name, step in peers(sequence.camera):
        if not any(word in name for word in arguments.without):
            chosen.append((name, step))
    rows = measure(sequence, indices, chosen, truth)
    if arguments.json:
        print(
            json.dumps({"source": sequence.name, "rows": [asdict(row) for row in rows]}, indent=1)
        )
        return
    print(f"{sequence.name}, {len(indices)} frames, stride {arguments.stride}; {isa()}\n\n{HEADER}")
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()
