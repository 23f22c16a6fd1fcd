"""Tracking with and without the self-calibration of the camera, on recordings and simulations.

    python -m tests.bench.bench_calibration [--source DIR ...] [--max-frames N] [--twice]

The runs of each sequence are without a calibration, with that of vignetting, of depth bias and of
the shutter's timing alone, and with all; and, with --twice, with all and the result of the run
before from the first frame on. For each run it prints the frames by tracking status, the ATE of the
poses in odometry over the frames that are not LOST and belong to the first submap, the last
held-out residuals of depth and color, the corrections in use, the readout of color, the readout and
the delay of depth, and the CPU time per frame of the tracker and of the calibration.
"""

import argparse
import logging
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from ldo_service.calibration.self_calibration import SelfCalibration, SelfCalibrationConfig
from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry.trajectory import Trajectory
from ldo_service.tracking.odometry import Odometry
from ldo_service.tracking.shutter import ShutterConfig


@dataclass
class Result:
    """Measurements of one run of the tracker alone."""

    calibration: SelfCalibration
    timing: ShutterTiming = field(default_factory=ShutterTiming)
    statuses: Counter[str] = field(default_factory=Counter)
    stamps_s: list[float] = field(default_factory=list)
    T_odom_camera: list[np.ndarray] = field(default_factory=list)
    tracking_s: float = 0.0  # CPU time.
    calibration_s: float = 0.0
    longest_s: float = 0.0  # Longest step of the calibration.


def tracked(
    sequence: Sequence, count: int, calibration: SelfCalibration, shutter: ShutterConfig
) -> Result:
    """Track the first `count` frames."""
    config = actor_parameters(load_config(None, [])).tracker.odometry
    odometry = Odometry(replace(config, shutter=shutter))
    result = Result(calibration)
    for index in range(min(count, len(sequence))):
        raw = sequence[index]
        start_s = time.process_time()
        corrected = result.calibration.correction.applied(raw)
        tracked = odometry.process(corrected, camera=calibration.knowledge)
        middle_s = time.process_time()
        T_odom_camera = None if tracked.status == "LOST" else tracked.T_odom_camera
        change = result.calibration.observe(raw, T_odom_camera, tracked.motion)
        if change is not None:
            odometry.recorrect(change)
        step_s = time.process_time() - middle_s
        result.tracking_s += middle_s - start_s
        result.calibration_s += step_s
        result.longest_s = max(result.longest_s, step_s)
        result.statuses[str(tracked.status)] += 1
        if tracked.status != "LOST" and tracked.submap == 0:
            result.stamps_s.append(1e-9 * raw.stamp_ns)
            result.T_odom_camera.append(tracked.T_odom_camera)
    result.timing = ShutterTiming.of(odometry.snapshot()["shutter"]["timing"])
    return result


def row(sequence: Sequence, result: Result) -> str:
    """Return the measurements as a line of text."""
    truth, ate = sequence.truth(), float("nan")
    if truth is not None and len(result.stamps_s) > 2:
        poses = Trajectory(np.array(result.stamps_s), np.array(result.T_odom_camera))
        ate = 100 * evaluate_trajectory(poses, truth).ate_m.rmse
    frames = sum(result.statuses.values())
    status = "/".join(str(result.statuses[name]) for name in ("OK", "WEAK", "LOST"))
    calibration = result.calibration
    used = [name for name, is_used in (
        ("depth", calibration.correction.has_depth_bias),
        ("color", calibration.correction.has_vignetting),
    ) if is_used]  # fmt: skip
    return (
        f"{status:>12s}  ATE {ate:6.2f} cm  residual {calibration.ratios[0]:.2f} "
        f"{calibration.ratios[1]:.2f}  corrected {' '.join(used) or '-':11s}  "
        f"shutter {' '.join(f'{1e3 * time_s:5.1f}' for time_s in result.timing.times_s)} ms  "
        f"tracking {1e3 * result.tracking_s / frames:5.1f} ms/frame, calibration "
        f"{result.calibration_s:4.1f} s in all, at most {1e3 * result.longest_s:3.0f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--source", nargs="+", default=["synthetic:tour-handheld"])
    parser.add_argument("--max-frames", type=int, default=300)
    parser.add_argument("--twice", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    logging.disable(logging.WARNING)
    for source in options.source:
        sequence = open_sequence(source)
        nothing, off = SelfCalibrationConfig(views=()), ShutterConfig(is_on=False)
        for name, config, shutter in (
            ("without", nothing, off),
            ("color", SelfCalibrationConfig(max_depth_ratio=0.0), off),
            ("depth", SelfCalibrationConfig(max_color_ratio=0.0), off),
            ("timing", nothing, ShutterConfig()),
            ("all", SelfCalibrationConfig(), ShutterConfig()),
        ):
            calibration = SelfCalibration(config)
            result = tracked(sequence, options.max_frames, calibration, shutter)
            print(f"{source} {name:7s} {row(sequence, result)}", flush=True)
        if options.twice:
            known = SelfCalibration.finished(calibration.correction)
            shutter = ShutterConfig(initial=result.timing)
            result = tracked(sequence, options.max_frames, known, shutter)
            print(f"{source} {'again':7s} {row(sequence, result)}", flush=True)


if __name__ == "__main__":
    main()
