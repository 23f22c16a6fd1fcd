"""Time of labelling one keyframe: 100 000 Gaussians in view, one thread, and against the twins.

    python tests/bench/bench_semantics.py [--gaussians 100000] [--repeats 15]

A wall at 3 m with twelve things before it, a quarter of the image, as surfels at random pixels of
640x480; each thing has a box. CPU ms of this thread, the median. The twins run on every 100th
Gaussian in the same process: read the ratio per Gaussian, where other work slows both.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from ldo_service.gaussians.model import aligned_rows
from ldo_service.geometry import Camera
from ldo_service.semantics.assignment import Regions, assign
from ldo_service.semantics.assignment_reference import assign_reference
from ldo_service.semantics.consistency import agree
from ldo_service.semantics.consistency_reference import agree_reference
from ldo_service.semantics.foreground import foreground, surfaces
from ldo_service.semantics.labelling import Claims, LabellingConfig, observations
from ldo_service.semantics.labels import NOT_SEEN, new_labels, observe
from ldo_service.semantics.labels_reference import observe_reference

CAMERA, CONFIG = Camera(640, 480, 520.0, 520.0, 319.5, 239.5), LabellingConfig()
SIDE_PX, MARGIN_PX = 80, 10


def scene(n: int) -> tuple[np.ndarray, np.ndarray, Claims]:
    """Rows [n, 16], depth [H, W], and what is claimed."""
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
    return rows, depth_m, Claims.of_detector(boxes, 2 + np.arange(len(boxes)) % 5, sure)


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        started_s = time.thread_time()
        work()
        times.append(1e3 * (time.thread_time() - started_s))
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    n, repeats = arguments.gaussians, arguments.repeats
    rows, depth_m, claims = scene(n)
    labels, indices, T = new_labels(n), np.arange(n, dtype=np.uint32), np.eye(4)
    pieces = surfaces(depth_m, CAMERA, CONFIG.foreground)
    parts = [foreground(b, depth_m, pieces, CAMERA, CONFIG.foreground) for b in claims.boxes]
    regions = Regions.of_foregrounds(claims.boxes, claims.scores(), parts)
    where = assign(rows, indices, CAMERA, T, depth_m, regions, CONFIG.assignment)
    seen = observations(where, indices, CAMERA, claims, CONFIG)
    observe(labels, seen, CONFIG.labels)
    touched = indices[seen.labels != NOT_SEEN]

    few, some = indices[: len(indices) // 100], indices[::100].copy()
    masks = [part.image(depth_m.shape) for part in parts]
    where_few = assign(rows, few, CAMERA, T, depth_m, regions, CONFIG.assignment)
    seen_few = observations(where_few, few, CAMERA, claims, CONFIG)
    view = CAMERA, T, depth_m, claims.boxes, claims.scores(), masks, CONFIG.assignment
    work: dict[str, tuple[Callable[[], object], Callable[[], object] | None]] = {
        "surfaces of the image": (lambda: surfaces(depth_m, CAMERA, CONFIG.foreground), None),
        "12 foregrounds": (
            lambda: [
                foreground(b, depth_m, pieces, CAMERA, CONFIG.foreground) for b in claims.boxes
            ],
            None,
        ),
        "assign": (
            lambda: assign(rows, indices, CAMERA, T, depth_m, regions, CONFIG.assignment),
            lambda: assign_reference(rows[some], *view),
        ),
        "fuse": (lambda: observations(where, indices, CAMERA, claims, CONFIG), None),
        "observe": (
            lambda: observe(labels, seen, CONFIG.labels),
            lambda: observe_reference(labels, seen_few, CONFIG.labels),
        ),
        "agree": (
            lambda: agree(rows, labels, touched, CONFIG.consistency),
            lambda: agree_reference(rows, labels, some, CONFIG.consistency),
        ),
    }
    print(f"{n} Gaussians, {len(touched)} seen, {np.mean(seen.labels >= 0):.0%} in regions")
    print("| step | ms | the twin, per Gaussian |\n|---|---|---|")
    total = 0.0
    for name, (ours, twin) in work.items():
        ms = cpu_ms(ours, repeats)
        total += ms * (name in ("assign", "fuse", "observe", "agree"))
        ratio = f"{100 * cpu_ms(twin, 3) / ms:.0f}x" if twin else ""
        print(f"| {name} | {ms:.2f} | {ratio} |", flush=True)
    print(f"| assign to agree | {total:.2f} | |")


if __name__ == "__main__":
    main()
