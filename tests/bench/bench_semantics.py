"""Time of labelling one keyframe with 100,000 Gaussians, compared with the NumPy reference.

    python tests/bench/bench_semantics.py [--gaussians 100000] [--repeats 15]

The scene has a wall at 3 m and twelve objects in front of it that cover a quarter of the image. Its
Gaussians are surfels at random pixels of 640x480, and each object has a box. Times are median CPU
ms of this thread. The whole is one call of `fuse_detections`, from boxes and depth to labels,
without data of the previous call in the cache. The references run in the same process, those over
Gaussians on every 100th one. On a busy machine read the ratio, which is for equal work.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera
from ldo_service.regions.foreground import (
    Foreground,
    RegionDetections,
    foreground,
    surfaces,
    without_nested,
)
from ldo_service.semantics.gaussian_labels import NOT_SEEN, new_labels, observe, smooth_labels
from ldo_service.semantics.label_assignment import Regions, assign_gaussians
from ldo_service.semantics.semantic_fusion import (
    SemanticFusionConfig,
    fuse_detections,
    observations,
)
from tests.reference.assignment import assign_reference
from tests.reference.consistency import agree_reference
from tests.reference.foreground import foreground_reference, surfaces_reference
from tests.reference.labels import observe_reference

CAMERA, CONFIG = Camera(640, 480, 520.0, 520.0, 319.5, 239.5), SemanticFusionConfig()
SIDE_PX, MARGIN_PX = 80, 10


def scene(n: int) -> tuple[np.ndarray, np.ndarray, RegionDetections]:
    """Return rows [n, 16], depth [H, W] and the detections."""
    rng, depth_m = np.random.default_rng(0), np.full((480, 640), 3.0, np.float32)
    corners = [(60 + 150 * k, 40 + 150 * j) for j in range(3) for k in range(4)]
    for k, (u, v) in enumerate(corners):
        depth_m[v : v + SIDE_PX, u : u + SIDE_PX] = 1.5 + 0.1 * k
    pixels = np.sort(rng.choice(depth_m.size, n, replace=False))
    rows = aligned_rows(n)
    rows[:] = 0
    rows[:, :3] = CAMERA.backproject(depth_m).reshape(-1, 3)[pixels]
    rows[:, 3:6] = np.log(depth_m.ravel()[pixels] / 520)[:, None]
    rows[:, 6], rows[:, 10] = 1, 2
    low = np.array(corners) - MARGIN_PX
    boxes = np.concatenate([low, low + SIDE_PX + 2 * MARGIN_PX], axis=1)
    sure = rng.uniform(0.3, 0.9, len(boxes)).astype(np.float32)
    return rows, depth_m, RegionDetections.of_detector(boxes, 2 + np.arange(len(boxes)) % 5, sure)


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        started_s = time.thread_time()
        work()
        times.append(1e3 * (time.thread_time() - started_s))
    return float(np.median(times))


@dataclass(frozen=True)
class Step:
    name: str
    ours: Callable[[], object]
    numpy_step: Callable[[], object] | None = None
    share: float = 1.0  # Fraction of our work that the reference does.

    def median_ms(self, repeats: int) -> float:
        """Print a line of the table and return the time in ms."""
        ms = cpu_ms(self.ours, repeats)
        ratio = f"{cpu_ms(self.numpy_step, 3) / self.share / ms:.0f}x" if self.numpy_step else ""
        print(f"| {self.name} | {ms:.2f} | {ratio} |", flush=True)
        return ms


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)  # This thread then has all CPU time of a reference.
    n, repeats = arguments.gaussians, arguments.repeats
    rows, depth_m, detections = scene(n)
    labels, indices, T = new_labels(n), np.arange(n, dtype=np.uint32), np.eye(4)
    image = depth_m, CAMERA, CONFIG.foreground
    pieces = surfaces(*image)
    in_image = depth_m, pieces, CAMERA, CONFIG.foreground
    parts = [foreground(box, *in_image) for box in detections.boxes]
    regions = Regions.of_foregrounds(detections.boxes, detections.scores(), parts)
    where = assign_gaussians(rows, indices, CAMERA, T, depth_m, regions, CONFIG.assignment)
    seen = observations(where, indices, CAMERA, detections, CONFIG)
    observe(labels, seen, CONFIG.labels)
    touched = indices[seen.labels != NOT_SEEN]

    few, some = indices[: len(indices) // 100], indices[::100].copy()
    masks = [part.image(depth_m.shape) for part in parts]
    where_few = assign_gaussians(rows, few, CAMERA, T, depth_m, regions, CONFIG.assignment)
    seen_few = observations(where_few, few, CAMERA, detections, CONFIG)
    view = CAMERA, T, depth_m, detections.boxes, detections.scores(), masks, CONFIG.assignment
    # The whole has its own labels: repeated calls of `smooth_labels` spread those of the steps.
    keyframe = rows, new_labels(n), indices, CAMERA, T, depth_m, detections, CONFIG
    steps = [
        Step("surfaces", lambda: surfaces(*image), lambda: surfaces_reference(*image)),
        Step(
            f"{len(detections.boxes)} foregrounds",
            lambda: [foreground(box, *in_image) for box in detections.boxes],
            lambda: [foreground_reference(box, *in_image) for box in detections.boxes],
        ),
        Step("nesting, tables", lambda: tables(detections, parts)),
        Step(
            "assign",
            lambda: assign_gaussians(rows, indices, CAMERA, T, depth_m, regions, CONFIG.assignment),
            lambda: assign_reference(rows[some], *view),
            0.01,
        ),
        Step("fuse", lambda: observations(where, indices, CAMERA, detections, CONFIG)),
        Step(
            "observe",
            lambda: observe(labels, seen, CONFIG.labels),
            lambda: observe_reference(labels, seen_few, CONFIG.labels),
            0.01,
        ),
        Step(
            "agree",
            lambda: smooth_labels(rows, labels, touched, CONFIG.consistency),
            lambda: agree_reference(rows, labels, some, CONFIG.consistency),
            0.01,
        ),
    ]
    print(f"{n} Gaussians, {len(touched)} observed, {np.mean(seen.labels >= 0):.0%} in regions")
    print("| step | ms | reference, for equal work |\n|---|---|---|")
    print(f"| sum | {sum(step.median_ms(repeats) for step in steps):.2f} | |")
    Step("whole", lambda: fuse_detections(*keyframe)).median_ms(repeats)


def tables(detections: RegionDetections, parts: Sequence[Foreground]) -> Regions:
    left = without_nested(parts, detections.scores(), CONFIG.nesting)
    return Regions.of_foregrounds(detections.boxes, detections.scores(), left)


if __name__ == "__main__":
    main()
