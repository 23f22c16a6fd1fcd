"""Our odometry beside OpenCV's RGB-D odometry on the same frames, one thread each.

    OMP_NUM_THREADS=1 python tests/bench/bench_tracking.py [SOURCE] [FRAMES] [STRIDE]

SOURCE: a data set or synthetic sequence; default: tum/kitchen in LDO_DATA, else synthetic:tour.
Accuracy: ATE RMSE in cm as `ldo eval` has it. Time: CPU ms per frame, decoding excluded.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Camera, RgbdFrame, Trajectory
from ldo_service.kernels import isa
from ldo_service.tracking import Odometry, Status

WARM_UP = 5  # frames left out of the times
Step = Callable[[RgbdFrame], tuple[np.ndarray, bool]]  # T_world_camera, and whether it is trusted


def ours() -> Step:
    odometry = Odometry()

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        tracked = odometry.track(frame)
        if tracked.wants_keyframe:
            odometry.make_keyframe(frame, tracked)
        return tracked.T_odom_camera, tracked.status is Status.OK

    return step


def opencv(camera: Camera) -> Step:
    """cv2.Odometry, colour and depth, frame to frame, at its defaults."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.matrix.astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    previous: list[cv2.OdometryFrame] = []
    T_world_camera = np.eye(4)

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        nonlocal T_world_camera
        depth_m = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
        current = cv2.OdometryFrame(depth_m, cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        odometry.prepareFrame(current)
        if not previous:
            previous.append(current)
            return T_world_camera, True
        found, T_previous_current = odometry.compute(current, previous.pop())
        previous.append(current)
        if found:
            T_world_camera = T_world_camera @ T_previous_current
        return T_world_camera, bool(found)

    return step


def measure(name: str, step: Step, sequence: Sequence, indices: range) -> None:
    poses, trusted, times_ms = [], [], []
    for index in indices:
        frame = sequence[index]
        start_s = time.process_time()
        T_world_camera, is_trusted = step(frame)
        times_ms.append(1e3 * (time.process_time() - start_s))
        poses.append(T_world_camera)
        trusted.append(is_trusted)
    p50, p95 = np.percentile(times_ms[WARM_UP:], [50, 95])
    truth = sequence.truth()
    assert truth is not None
    estimate = Trajectory(sequence.stamps_ns[indices] * 1e-9, np.array(poses))
    ate_cm = 100 * evaluate_trajectory(estimate, truth).ate_m.rmse
    print(f"| {name} | {ate_cm:.2f} | {100 * np.mean(trusted):.1f} | {p50:.1f} | {p95:.1f} |")


def default_source() -> str:
    kitchen = Path(os.environ.get("LDO_DATA", "")) / "tum" / "kitchen"
    return str(kitchen) if kitchen.is_dir() else "synthetic:tour"


def main() -> None:
    source = sys.argv[1] if len(sys.argv) > 1 else default_source()
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 300
    stride = int(sys.argv[3]) if len(sys.argv) > 3 else 1
    sequence = open_sequence(source)
    indices = range(len(sequence))[:count:stride]
    cv2.setNumThreads(1)
    print(f"{sequence.name}, {len(indices)} frames, stride {stride}; {isa()}, {cv2.__version__}\n")
    print("| | ATE RMSE cm | trusted % | CPU ms p50 | p95 |\n|---|---|---|---|---|")
    measure("ours", ours(), sequence, indices)
    if not hasattr(cv2, "Odometry"):
        print(f"| OpenCV: skipped, {cv2.__version__} has no cv2.Odometry | | | | |")
        return
    measure("OpenCV RGB-D odometry", opencv(sequence.camera), sequence, indices)


if __name__ == "__main__":
    main()
