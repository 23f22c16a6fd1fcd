"""Errors of the tracked poses relative to their covariance, on sequences with exact ground truth.

    python -m tests.bench.bench_covariance [--source SOURCE ...] [--max-frames N]

An error is that of T_reference_camera, the pose of a frame in its reference keyframe, which is the
pose that the covariance belongs to. For each sequence the program prints the frames that are OK,
the normalized estimation error squared (NEES, expected value 6), and the share of the OK frames
whose position or rotation errs by more than three times its standard deviation.
"""

import argparse
import logging
from dataclasses import replace

import cv2
import numpy as np

from ldo_service.calibration.self_calibration import SelfCalibration, SelfCalibrationConfig
from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.geometry import se3
from ldo_service.tracking import TrackingStatus
from ldo_service.tracking.odometry import Odometry
from ldo_service.tracking.shutter import ShutterConfig

SOURCES = (
    "synthetic:tour",
    "synthetic:tour-noisy",
    "synthetic:flat",
    "synthetic:flat-exact",
    "synthetic:tour-handheld",
    "synthetic:room-handheld",
)
MAX_STAMP_DIFFERENCE_S = 0.02


def errors_and_covariances(
    sequence: Sequence, count: int, *, is_calibrated: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Track the first `count` frames, and compare the OK frames with the ground truth.

    Returns:
        Errors of T_reference_camera, [N, 6], rotation first, in rad and m; and their covariances,
        [N, 6, 6].
    """
    config = actor_parameters(load_config(None, [])).tracker.odometry
    odometry = Odometry(replace(config, shutter=ShutterConfig(is_on=is_calibrated)))
    calibration = SelfCalibration(None if is_calibrated else SelfCalibrationConfig(views=()))
    truth = sequence.truth()
    assert truth is not None
    T_true: dict[int, np.ndarray] = {}  # By keyframe.
    errors, covariances = [], []
    for index in range(min(count, len(sequence))):
        raw = sequence[index]
        frame = calibration.correction.applied(raw)
        tracked = odometry.process(frame, camera=calibration.knowledge)
        is_lost = tracked.status is TrackingStatus.LOST
        T_odom_camera = None if is_lost else tracked.T_odom_camera
        change = calibration.observe(raw, T_odom_camera, tracked.motion)
        if change is not None:
            odometry.recorrect(change)
        nearest = int(np.argmin(np.abs(truth.stamps_s - 1e-9 * raw.stamp_ns)))
        if abs(truth.stamps_s[nearest] - 1e-9 * raw.stamp_ns) > MAX_STAMP_DIFFERENCE_S:
            continue
        T_world_camera = truth.T_world_camera[nearest]
        T_world_reference = T_true.get(-1 if tracked.reference is None else tracked.reference)
        if tracked.keyframe is not None:
            T_true[tracked.keyframe.id] = T_world_camera
        if T_world_reference is None or not tracked.information.any():
            continue
        if tracked.status is TrackingStatus.OK:
            T_reference_camera = se3.inverse(T_world_reference) @ T_world_camera
            errors.append(se3.log(se3.inverse(tracked.T_reference_camera) @ T_reference_camera))
            covariances.append(np.linalg.inv(tracked.information))
    return np.array(errors).reshape(-1, 6), np.array(covariances).reshape(-1, 6, 6)


def row(errors: np.ndarray, covariances: np.ndarray) -> str:
    """Return the statistics of errors [N, 6] with covariances [N, 6, 6] as a line of text."""
    if not len(errors):
        return "no OK frame with ground truth"
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
    parts = [f"{len(errors):4d} OK  NEES mean {nees.mean():7.1f} median {np.median(nees):7.1f}"]
    for name, part, unit in (("position", slice(3, 6), "mm"), ("rotation", slice(3), "mrad")):
        size = 1e3 * np.linalg.norm(errors[:, part], axis=1)
        sigma = 1e3 * np.sqrt(np.trace(covariances[:, part, part], axis1=1, axis2=2))
        parts.append(
            f"{name} {np.median(size):6.3f} {unit}, sigma {np.median(sigma):6.3f}, "
            f"beyond 3 sigma {100 * np.mean(size > 3 * sigma):5.2f} %"
        )
    return "  ".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--source", nargs="+", default=SOURCES)
    parser.add_argument("--max-frames", type=int, default=300)
    parser.add_argument("--without-calibration", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    logging.disable(logging.WARNING)
    for source in options.source:
        measured = errors_and_covariances(
            open_sequence(source),
            options.max_frames,
            is_calibrated=not options.without_calibration,
        )
        print(f"{source:24s} {row(*measured)}", flush=True)


if __name__ == "__main__":
    main()
