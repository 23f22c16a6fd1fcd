"""Tracking against depth rendered from the map, compared with depth of the sensor.

    python tests/bench/bench_map_view.py [SOURCE ...] [--frames N]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. The mapper densifies and optimizes the map at each keyframe before the
next frame is tracked. A rendering is therefore newer than in any service. In a reference keyframe
the median depth of the map replaces that of the sensor where the map is opaque and within 3 % of
it. `mean` is the mean of both.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.renderer import Rendering
from ldo_service.geometry import RgbdFrame, Trajectory
from ldo_service.tracking import Odometry, OdometryConfig, TrackingStatus
from ldo_service.tracking.tracking_result import TrackedFrame
from ldo_service.tracking.window import WindowConfig

MIN_OPACITY, NEAR = 0.9, 0.03  # NEAR is a fraction of the depth.
ITERATIONS = 10  # Iterations of the mapper per keyframe.
MODELS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray] | None] = {
    "sensor": None,
    "map": lambda of_map, _of_sensor: of_map,
    "mean": lambda of_map, of_sensor: (of_map + of_sensor) / 2,
}


class MapViewOdometry(Odometry):
    """Odometry that tracks against keyframes with depth rendered from the map."""

    def __init__(self, model: str) -> None:
        super().__init__(OdometryConfig(window=WindowConfig(measurements=0)))
        self._mix = MODELS[model]
        self._builder, self._mapped = MapBuilder(threads=2), 0

    def _add_mapping_keyframe(self, frame: RgbdFrame, tracked: TrackedFrame) -> int:
        self._insert(frame, tracked)
        return super()._add_mapping_keyframe(frame, tracked)

    def _add_reference(
        self, frame: RgbdFrame, tracked: TrackedFrame, *, is_connected: bool = False
    ) -> int:
        self._insert(frame, tracked)
        seen = self._as_mapped(frame, tracked)
        return super()._add_reference(seen, tracked, is_connected=is_connected)

    def _insert(self, frame: RgbdFrame, tracked: TrackedFrame) -> None:
        if self._mix is not None:
            self._builder.add(frame, tracked.T_odom_camera, self._mapped, ITERATIONS)
            self._mapped += 1

    def _as_mapped(self, frame: RgbdFrame, tracked: TrackedFrame) -> RgbdFrame:
        if self._mix is None:
            return frame
        seen = self._builder.render_from(frame.camera, tracked.T_odom_camera)
        mixed = self._mix(seen.median_depth_m, frame.depth_m)
        depth_m = np.where(_agrees(seen, frame), mixed, frame.depth_m)
        return replace(frame, depth_m=depth_m.astype(np.float32))


def _agrees(seen: Rendering, frame: RgbdFrame) -> np.ndarray:
    """Return a mask [H, W] of where the map is opaque and agrees with the sensor's depth."""
    apart_m = np.abs(seen.median_depth_m - frame.depth_m)
    return (seen.opacity > MIN_OPACITY) & (frame.depth_m > 0) & (apart_m < NEAR * frame.depth_m)


def row(sequence: Sequence, frames: int, model: str) -> str:
    truth = sequence.truth()
    if truth is None:
        raise SystemExit(f"{sequence.name} has no ground truth; choose another sequence.")
    odometry, poses, trusted = MapViewOdometry(model), [], 0
    for index in range(frames):
        result = odometry.process(sequence[index])
        poses.append(result.T_odom_camera)
        trusted += result.status is TrackingStatus.OK
    stamps_s = sequence.stamps_ns[:frames] * 1e-9
    ate_m = evaluate_trajectory(Trajectory(stamps_s, np.array(poses)), truth).ate_m.rmse
    return f"| {sequence.name} | {frames} | {model} | {100 * ate_m:.2f} | {trusted / frames:.1%} |"


def default_sources() -> list[str]:
    data = os.environ.get("LDO_DATA")
    folders = ("tum/kitchen", "replica/apartment_floor1") if data else ()
    return [*(str(Path(data or "") / folder) for folder in folders), "synthetic:flat"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--frames", type=int, default=120)
    arguments = parser.parse_args()
    print(
        "| source | frames | depth of keyframes | ATE RMSE cm | status OK |\n|---|---|---|---|---|"
    )
    for source in arguments.sources or default_sources():
        sequence = open_sequence(source)
        for model in MODELS:
            print(row(sequence, min(arguments.frames, len(sequence)), model), flush=True)


if __name__ == "__main__":
    main()
