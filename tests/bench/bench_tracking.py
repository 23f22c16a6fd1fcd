"""Our odometry beside OpenCV's RGB-D odometry on the same real frames, one thread each.

    OMP_NUM_THREADS=1 LDO_DATA=... python tests/bench/bench_tracking.py [FRAMES] [STRIDE]

Accuracy: ATE RMSE in cm after SE(3) alignment. Time: CPU ms per frame, decoding excluded.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from ldo_service.geometry import Camera, RgbdFrame
from ldo_service.kernels import _align
from ldo_service.tracking import Odometry, Status

Step = Callable[[RgbdFrame], tuple[np.ndarray, bool]]  # T_world_camera, and whether it is trusted


def rows(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines()
    return [line.split() for line in lines if line and not line.startswith("#")]


def frames(root: Path, count: int, stride: int) -> Iterator[tuple[RgbdFrame, np.ndarray]]:
    """Frames of a TUM folder, with the true position [3] at the nearest stamp."""
    calibration = json.loads((root / "camera.json").read_text())
    scale = calibration.pop("depth_scale")
    camera = Camera(**calibration)
    depths, truth = rows(root / "depth.txt"), np.array(rows(root / "groundtruth.txt"), float)
    depth_stamps = np.array([float(stamp) for stamp, _ in depths])
    for index, (stamp, name) in enumerate(rows(root / "rgb.txt")[:count:stride]):
        time_s = float(stamp)
        depth_name = depths[int(np.argmin(np.abs(depth_stamps - time_s)))][1]
        color = cv2.cvtColor(cv2.imread(str(root / name)), cv2.COLOR_BGR2RGB)
        depth = cv2.imread(str(root / depth_name), cv2.IMREAD_UNCHANGED)
        depth_m = (depth / scale).astype(np.float32)
        position = truth[np.argmin(np.abs(truth[:, 0] - time_s)), 1:4]
        yield RgbdFrame(color, depth_m, camera, round(time_s * 1e9), index), position


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


def ate_rmse_m(estimate: np.ndarray, truth: np.ndarray) -> float:
    """After the best rigid alignment of positions [N, 3] (Horn 1987)."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.mean(np.sum((b - a @ R.T) ** 2, axis=1))))


def measure(name: str, step: Step, sequence: Iterable[tuple[RgbdFrame, np.ndarray]]) -> None:
    positions, truth, trusted, times_ms = [], [], [], []
    for frame, position in sequence:
        start_s = time.process_time()
        T_world_camera, is_trusted = step(frame)
        times_ms.append(1e3 * (time.process_time() - start_s))
        positions.append(T_world_camera[:3, 3])
        truth.append(position)
        trusted.append(is_trusted)
    p50, p95 = np.percentile(times_ms[5:], [50, 95])  # the first five warm up
    ate_cm = 100 * ate_rmse_m(np.array(positions), np.array(truth))
    print(f"| {name} | {ate_cm:.2f} | {100 * np.mean(trusted):.1f} | {p50:.1f} | {p95:.1f} |")


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    stride = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    root = Path(os.environ.get("LDO_DATA", "")) / "tum" / "kitchen"
    if not root.is_dir():
        print(f"skipped: {root} is missing; set LDO_DATA to the folder that holds tum/kitchen")
        return
    cv2.setNumThreads(1)
    print(f"kitchen, {count} frames, stride {stride}; {_align.isa}, OpenCV {cv2.__version__}\n")
    print("| | ATE RMSE cm | trusted % | CPU ms p50 | p95 |\n|---|---|---|---|---|")
    measure("ours", ours(), frames(root, count, stride))
    if not hasattr(cv2, "Odometry"):
        print(f"| OpenCV: skipped, {cv2.__version__} has no cv2.Odometry | | | | |")
        return
    camera = next(frames(root, 1, 1))[0].camera
    measure("OpenCV RGB-D odometry", opencv(camera), frames(root, count, stride))


if __name__ == "__main__":
    main()
