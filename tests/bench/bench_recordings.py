"""Trajectories of one sequence after its conversion to each format of recordings.

    python -m tests.bench.bench_recordings SOURCE --max-frames 200

The frames of SOURCE, a data set, are written in each format by its own library (rosbags, PyAV,
liblzfse) or by a small writer (`tests.datasets.recordings`), and tracked by the tracker alone.
Formats without absolute stamps get those of the frames. --priors instead tracks the original
frames with the true poses as odometry prior, exact and disturbed. The conversions need about 1 GB
of temporary space for 200 frames of 640x480 pixels.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.registration import register_depth
from ldo_service.runs.source import PriorSource
from ldo_service.tracking.odometry import Odometry
from ldo_service.tracking.odometry_prior import OdometryPriorBuffer, PriorConfig
from tests.datasets.bags import entries_of, write_bag
from tests.datasets.recordings import (
    DEPTH_SIZE,
    T_COLOR_DEPTH,
    azure_calibration,
    write_azure,
    write_nerfstudio,
    write_open3d,
    write_r3d,
    write_sens,
    write_stray,
)


class Restamped(Sequence):
    """Sequence with the stamps of the original frames."""

    def __init__(self, sequence: Sequence, stamps_ns: np.ndarray) -> None:
        super().__init__(sequence.name, sequence.raw_camera, stamps_ns)
        self._sequence = sequence

    def read(self, index: int) -> RawFrame:
        return replace(self._sequence.read(index), stamp_ns=int(self.stamps_ns[index]))

    def truth(self) -> Trajectory | None:
        return None


class Selected(Sequence):
    """Every n-th frame of a sequence, at most `count`, at the stamps of successive frames.

    The camera is thus n times as fast.
    """

    def __init__(self, sequence: Sequence, stride: int, count: int) -> None:
        self._indices = range(0, len(sequence), stride)[:count]
        stamps_ns = sequence.stamps_ns[: len(self._indices)]
        super().__init__(sequence.name, sequence.raw_camera, stamps_ns)
        self._sequence = sequence

    def read(self, index: int) -> RawFrame:
        raw = self._sequence.read(self._indices[index])
        return replace(raw, index=index, stamp_ns=int(self.stamps_ns[index]))

    def truth(self) -> Trajectory | None:
        """Return the true poses of the selected frames, interpolated, at their new stamps."""
        truth = self._sequence.truth()
        if truth is None:
            return None
        times_s = self._sequence.stamps_ns[list(self._indices)] * 1e-9
        after = np.clip(np.searchsorted(truth.stamps_s, times_s), 1, len(truth) - 1)
        before = after - 1
        span_s = truth.stamps_s[after] - truth.stamps_s[before]
        share = (times_s - truth.stamps_s[before]) / span_s
        poses = truth.T_world_camera
        return Trajectory(self.stamps_ns / 1e9, se3.interpolate(poses[before], poses[after], share))


@dataclass(frozen=True, slots=True)
class Result:
    """Result of tracking."""

    poses: np.ndarray  # [N, 4, 4], T_odom_camera.
    with_pose: int  # Number of frames that are not LOST.
    ate_cm: float
    cpu_ms: float  # CPU time of tracking per frame, without reading.


def track(sequence: Sequence, truth: Trajectory, odometry: Trajectory | None = None) -> Result:
    """Track all frames, with an odometry prior if there is one."""
    odometer, prior, source = Odometry(), OdometryPriorBuffer(), PriorSource(odometry)
    poses, with_pose, cpu_s = [], 0, 0.0
    for frame in sequence:
        for pose in source.until(frame.stamp_ns):
            T_odom_base = pose_from_message(pose.T_prior_base)
            prior, _ = prior.added(pose.stamp_ns, T_odom_base, PriorConfig())
        started_s = time.process_time()
        result = odometer.process(frame, prior)
        cpu_s += time.process_time() - started_s
        poses.append(result.T_odom_camera)
        with_pose += str(result.status) != "LOST"
    estimate = Trajectory(sequence.stamps_ns / 1e9, np.array(poses))
    ate_m = evaluate_trajectory(estimate, truth).ate_m.rmse
    return Result(np.array(poses), with_pose, 100 * ate_m, 1000 * cpu_s / len(sequence))


def azure(folder: Path, frames: list[RawFrame]) -> Path:
    """Write the frames as those of an Azure Kinect; its depth camera is 3 cm beside the other."""
    color = frames[0].camera
    depth = Camera(320, 288, 0.45 * color.fx, 0.45 * color.fy, 159.5, 143.5)
    T_depth_color = se3.inverse(T_COLOR_DEPTH)
    images = [(frame.color, seen_by(frame, depth, T_depth_color)) for frame in frames]
    return write_azure(folder / "kinect.mkv", images, azure_calibration(color, depth))


def seen_by(frame: RawFrame, depth: Camera, T_depth_color: np.ndarray) -> np.ndarray:
    """Return the depth [288, 320] in millimeters that the depth camera would measure."""
    depth_m = register_depth(frame.depth_m(), frame.camera, depth, T_depth_color)
    return np.round(depth_m * 1000).astype(np.uint16)


def formats(
    sequence: Sequence, frames: list[RawFrame]
) -> Iterator[tuple[str, Callable[[Path], Path]]]:
    """Yield the name of each format, and a writer."""
    indices = range(len(frames))
    for name, kind in (("ROS 1", "ros1"), ("ROS 2, MCAP", "mcap"), ("ROS 2, sqlite3", "sqlite3")):
        yield name, lambda p, kind=kind: write_bag(p, kind, entries_of(sequence, indices))
    yield "nerfstudio, PNG", lambda p: write_nerfstudio(p / "scan", frames)
    yield ".sens, PNG", lambda p: write_sens(p / "scan.sens", frames, ".png")
    yield ".sens, JPEG", lambda p: write_sens(p / "scan.sens", frames)
    yield "Open3D, depth in millimeters", lambda p: write_open3d(p / "scan", frames)
    yield "nerfstudio, depth 256x192", lambda p: write_nerfstudio(p, frames, DEPTH_SIZE)
    yield "Record3D, JPEG, depth 256x192", lambda p: write_r3d(p / "a.r3d", frames, DEPTH_SIZE)
    yield (
        "Stray Scanner, video 1920x1440, depth 256x192",
        lambda p: write_stray(p / "scan", frames, enlarged=3),
    )
    yield "Azure Kinect, MJPEG, depth 320x288 of another camera", lambda p: azure(p, frames)


def disturbed(T_world_camera: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and poses [N, 4, 4] of odometries, from exact to useless."""
    random = np.random.default_rng(0)
    yield "exact", T_world_camera
    steps = se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]

    def integrated(steps: np.ndarray) -> np.ndarray:
        poses = [T_world_camera[0]]
        for step in steps:
            poses.append(poses[-1] @ step)
        return np.array(poses)

    longer = steps.copy()
    longer[:, :3, 3] *= 1.05
    yield "5 % too long", integrated(longer)
    noise = random.normal(0, 1, (len(steps), 6)) * [*[0.005] * 3, *[0.005] * 3]
    yield (
        "noise of 0.3 degrees and 5 mm per frame",
        integrated(steps @ np.array(list(map(se3.exp, noise)))),
    )
    jumps = steps.copy()
    jumps[::40, :3, 3] += 0.5
    yield "jump of 0.9 m every 40 frames", integrated(jumps)
    yield "camera that never moves", np.tile(T_world_camera[0], (len(T_world_camera), 1, 1))
    yield "motion in reverse", integrated(se3.inverse(steps))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source")
    parser.add_argument("--max-frames", type=int, default=200)
    parser.add_argument("--stride", type=int, default=1, help="make the camera N times as fast")
    parser.add_argument("--only", default="", help="part of the name of the formats to run")
    parser.add_argument("--priors", action="store_true", help="run with odometries instead")
    options = parser.parse_args()
    sequence = Selected(open_sequence(options.source), options.stride, options.max_frames)
    truth = sequence.truth()
    assert truth is not None, "the ground truth is needed"
    original = track(sequence, truth)
    print("| format | frames with a pose | ATE, cm | of the original | poses | CPU per frame |")
    print("|---|---|---|---|---|---|", flush=True)

    def row(name: str, result: Result) -> None:
        note = "same bytes" if result.poses.tobytes() == original.poses.tobytes() else "differ"
        ratio = result.ate_cm / original.ate_cm
        print(
            f"| {name} | {result.with_pose} of {len(sequence)} | {result.ate_cm:.2f} | {ratio:.3f} "
            f"| {note} | {result.cpu_ms:.1f} ms |",
            flush=True,
        )

    row("original", original)
    if options.priors:
        for name, poses in disturbed(truth.T_world_camera):
            row(name, track(sequence, truth, Trajectory(truth.stamps_s, poses)))
        return
    frames = [sequence.read(k) for k in range(len(sequence))]
    for name, write in formats(sequence, frames):
        if options.only.lower() in name.lower():
            with tempfile.TemporaryDirectory() as folder:
                path = write(Path(folder))
                converted = Restamped(open_sequence(str(path)), sequence.stamps_ns)
                row(name, track(converted, truth))


if __name__ == "__main__":
    main()
