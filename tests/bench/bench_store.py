"""Milliseconds and bytes of a keyframe, and of a chunk of sleeping Gaussians, on disk.

python tests/bench/bench_store.py SOURCE [--keyframes 50] [--stride 10] [--folder FOLDER]

CPU milliseconds of one thread, medians; the disk's own time shows in the wall column.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ldo_service.datasets import open_sequence
from ldo_service.gaussians import View
from ldo_service.gaussians.keyframe_images import KeyframeImages
from ldo_service.gaussians.keyframe_store import KeyframeStore, KeyframeStoreConfig


def timed_ms(do: Callable[[], object]) -> tuple[float, float]:
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    do()
    return 1e3 * (time.process_time() - cpu_s), 1e3 * (time.perf_counter() - wall_s)


def report(what: str, times_ms: list[tuple[float, float]]) -> None:
    cpu_ms, wall_ms = np.median(times_ms, axis=0)
    worst_ms = max(wall for _, wall in times_ms)
    print(f"{what:>12} {cpu_ms:8.2f} ms CPU {wall_ms:8.2f} ms wall, worst {worst_ms:.2f}")


def bench_keyframes(source: str, count: int, stride: int, folder: Path) -> None:
    sequence = open_sequence(source)
    frames = [sequence[i] for i in range(0, len(sequence), stride)][:count]
    images = [KeyframeImages.of(View.of(f, np.eye(4), k)) for k, f in enumerate(frames)]
    store = KeyframeStore(folder, KeyframeStoreConfig(cache_mb=0))
    puts = [timed_ms(lambda one=one: store.put(one)) for one in images]
    gets = [timed_ms(lambda one=one: store.get(one.keyframe)) for one in images]
    for one in images:
        got = store.get(one.keyframe)
        if got is None or got.depth_m.tobytes() != one.depth_m.tobytes():
            sys.exit(f"keyframe {one.keyframe} did not come back: the times mean nothing.")
    memory_mb = sum(one.nbytes for one in images) / 1e6
    disk_mb = store.statistics()["keyframes_disk_mb"]
    print(f"{source}: {len(images)} keyframes of {sequence.camera.width}x{sequence.camera.height}")
    report("put", puts)
    report("get", gets)
    print(
        f"{disk_mb / len(images):.3f} MB per keyframe on disk, {memory_mb / len(images):.3f} in "
        f"memory: {memory_mb / disk_mb:.2f} to 1"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source")
    parser.add_argument("--keyframes", type=int, default=50)
    parser.add_argument("--stride", type=int, default=10, help="frames between two keyframes")
    parser.add_argument("--folder", type=Path, help="on the disk to measure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        bench_keyframes(
            arguments.source, arguments.keyframes, arguments.stride, Path(folder) / "keyframes"
        )


if __name__ == "__main__":
    main()
