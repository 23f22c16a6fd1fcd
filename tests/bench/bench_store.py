"""Time and size of keyframes and of offloaded Gaussians on disk.

python tests/bench/bench_store.py [SOURCE] [--keyframes 50] [--stride 10] [--active N] [--folder F]

Times are median CPU milliseconds of one thread; the wall column includes the time of the disk.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ldo_service.datasets import open_sequence
from ldo_service.gaussians import GaussianMap, TrainingView, densify
from ldo_service.gaussians.keyframe_store import KeyframeStore, KeyframeStoreConfig
from ldo_service.gaussians.offloading import OffloadedGaussians
from ldo_service.gaussians.training_views import KeyframeImages
from ldo_service.gaussians.visibility import BoundingSpheres, PlacedCamera


def timed_ms(do: Callable[[], object]) -> tuple[float, float]:
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    do()
    return 1e3 * (time.process_time() - cpu_s), 1e3 * (time.perf_counter() - wall_s)


def report(what: str, times_ms: list[tuple[float, float]]) -> None:
    cpu_ms, wall_ms = np.median(times_ms, axis=0)
    worst_ms = max(wall for _, wall in times_ms)
    print(f"{what:>12} {cpu_ms:8.2f} ms CPU {wall_ms:8.2f} ms wall, max {worst_ms:.2f}")


def bench_keyframes(source: str, count: int, stride: int, folder: Path) -> None:
    sequence = open_sequence(source)
    frames = [sequence[i] for i in range(0, len(sequence), stride)][:count]
    images = [KeyframeImages.of(TrainingView.of(f, np.eye(4), k)) for k, f in enumerate(frames)]
    memory_mb = sum(one.nbytes for one in images) / 1e6
    store = KeyframeStore(folder, KeyframeStoreConfig(cache_mb=memory_mb / 2))  # Too small for all.
    puts = [timed_ms(lambda one=one: store.put(one)) for one in images]
    gets = [timed_ms(lambda one=one: store.get(one.keyframe)) for one in images]
    if store.metrics()["keyframes_read"] < len(images):
        sys.exit("some keyframes were read from the cache, which is faster; use more keyframes.")
    for one in images:
        got = store.get(one.keyframe)
        if got is None or got.depth_m.tobytes() != one.depth_m.tobytes():
            sys.exit(f"keyframe {one.keyframe} differs after reading; the store is broken.")
    disk_mb = store.metrics()["keyframes_disk_mb"]
    print(f"{source}: {len(images)} keyframes of {sequence.camera.width}x{sequence.camera.height}")
    report("put", puts)
    report("get", gets)
    print(
        f"{disk_mb / len(images):.3f} MB per keyframe on disk, {memory_mb / len(images):.3f} in "
        f"memory: {memory_mb / disk_mb:.2f} to 1"
    )


def bench_offload(source: str, count: int, stride: int, active: int, folder: Path) -> None:
    """Measure offloading in a map of `active` Gaussians, copies of those of `count` keyframes."""
    rows, anchors, poses = mapped(source, count, stride)
    times = -(-active // len(rows))
    gaussians = GaussianMap(active)
    for anchor in range(times * count):
        poses[anchor] = poses[anchor % count]
        gaussians.add(rows[anchors == anchor % count], anchor)
    print(f"{source}: {len(gaussians)} Gaussians on {len(poses)} anchors")
    offloaded, before = OffloadedGaussians(folder), gaussians.rows.copy()
    offloaded_chunks = list(range(0, len(poses), 2))

    def spheres() -> BoundingSpheres:
        return BoundingSpheres.around(gaussians.rows, gaussians.anchors)

    report("spheres", [timed_ms(spheres)])
    report(
        "offload half",
        [timed_ms(lambda: offloaded.offload_from(gaussians, gaussians.anchors, offloaded_chunks))],
    )
    chunks, memory_mb = len(offloaded.numbers()), len(offloaded) * 64 / 1e6
    disk_mb = sum(file.stat().st_size for file in folder.iterdir()) / 1e6
    camera = PlacedCamera(open_sequence(source).camera, poses[0])
    offloaded.visible_chunks(camera)
    report("visibility", [timed_ms(lambda: offloaded.visible_chunks(camera)) for _ in range(9)])
    report("load half", [timed_ms(lambda: offloaded.load_into(gaussians, offloaded.numbers()))])
    if gaussians.rows.tobytes() != before.tobytes():
        sys.exit("the Gaussians differ after loading; offloading is broken.")
    print(
        f"{chunks} chunks of {1e3 * memory_mb / chunks:.0f} kB in memory, "
        f"{memory_mb / disk_mb:.2f} to 1 on disk"
    )


def mapped(
    source: str, count: int, stride: int
) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Return rows and anchors of the Gaussians of the first keyframes, and the true poses."""
    sequence = open_sequence(source)
    truth, gaussians, poses = sequence.truth(), GaussianMap(), {}
    if truth is None:
        sys.exit(f"{source} has no true poses.")
    for keyframe in range(count):
        frame = sequence[keyframe * stride]
        nearest = int(np.argmin(np.abs(truth.stamps_s - 1e-9 * frame.stamp_ns)))
        poses[keyframe] = truth.T_world_camera[nearest]
        densify(gaussians, frame, poses[keyframe], keyframe)
    return gaussians.rows, gaussians.anchors, poses


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default="synthetic:room")
    parser.add_argument("--keyframes", type=int, default=50)
    parser.add_argument("--stride", type=int, default=10, help="frames between two keyframes")
    parser.add_argument("--active", type=int, default=1_500_000, help="Gaussians in the map")
    parser.add_argument("--folder", type=Path, help="folder on the disk to measure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        chosen = arguments.source, arguments.keyframes, arguments.stride
        bench_keyframes(*chosen, Path(folder) / "keyframes")
        bench_offload(*chosen, arguments.active, Path(folder) / "sleep")


if __name__ == "__main__":
    main()
