"""Time of one rendering, and against the prototype that set the bar.

    LDO_SKETCHES=.../sketches python tests/bench/bench_render.py [--repeats 30] [--threads 1]

Without LDO_SKETCHES the prototype is left out. Both run in turns in this process, so that other
work on the machine slows both: read the ratio, not the milliseconds. The prototype is compiled
here with the flags of its README, and the instruction sets are matched through LDO_ISA.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ldo_service.kernels import _rasterise

SIZES = ((100_000, 640, 480), (100_000, 320, 240), (500_000, 640, 480))
T_CAMERA_MAP = np.eye(4, dtype=np.float32)[:3]


def room(n: int, width: int, height: int, seed: int = 0) -> np.ndarray:
    """Rows of n flat Gaussians on the walls of a room, each about as wide as its share of pixels;
    a tenth of them lies beyond the edges of the image."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.65, 0.65, n), rng.uniform(-0.5, 0.5, n)
    z = np.minimum(4, np.minimum(1.5 / np.abs(y).clip(0.01), 2.2 / np.abs(x).clip(0.01)))
    z *= 1 + 0.02 * rng.standard_normal(n)
    sigma = 0.9 * z * np.sqrt(width * height / n) / (0.82 * width)
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = np.stack([x * z, y * z, z], -1)
    rows[:, 3:6] = np.log(sigma[:, None] * [1, 1, 0.2] * rng.uniform(0.6, 1.5, (n, 3)))
    rows[:, 6:10] = rng.standard_normal((n, 4))
    rows[:, 10] = rng.uniform(0, 4, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def ours(rows: np.ndarray, width: int, height: int, threads: int) -> Callable[[], np.ndarray]:
    f, cx, cy = 0.82 * width, (width - 1) / 2, (height - 1) / 2

    def run() -> np.ndarray:
        return _rasterise.rasterise(rows, T_CAMERA_MAP, f, f, cx, cy, width, height, threads)[0]

    return run


def compiled_prototype(folder: Path) -> ctypes.CDLL | None:
    sketches = os.environ.get("LDO_SKETCHES")
    if not sketches or _rasterise.isa() == "baseline":
        return None
    library = folder / "prototype.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
    flags += ["-DNO512"] if _rasterise.isa() == "avx2" else []
    source = Path(sketches) / "raster" / "rast.cpp"
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    out = ctypes.CDLL(str(library))
    out.rc_new.restype = ctypes.c_void_p
    return out


def prototype(
    library: ctypes.CDLL, rows: np.ndarray, width: int, height: int, threads: int
) -> Callable[[], np.ndarray]:
    f, cx, cy = 0.82 * width, (width - 1) / 2, (height - 1) / 2
    camera = np.array([*np.eye(3).ravel(), 0, 0, 0, f, f, cx, cy], np.float32)
    planes = np.zeros((5, height, width), np.float32)
    context = ctypes.c_void_p(library.rc_new())
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (rows, camera, planes)]
    library.rc_threads(threads)

    def run() -> np.ndarray:
        library.rc_forward(
            context, len(rows), pointers[0], pointers[1], width, height, pointers[2], 0
        )
        return planes[:3].transpose(1, 2, 0)

    return run


def medians_ms(runs: list[Callable[[], np.ndarray]], repeats: int) -> list[float]:
    """Of each, run in turns, after one turn to warm up."""
    times = np.zeros((repeats + 1, len(runs)))
    for turn in times:
        for k, run in enumerate(runs):
            start = time.perf_counter()
            run()
            turn[k] = time.perf_counter() - start
    return [float(t) * 1e3 for t in np.median(times[1:], axis=0)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    print(f"isa {_rasterise.isa()}, {arguments.threads} thread(s), median of {arguments.repeats}")
    print(f"{'Gaussians':>10} {'image':>9} {'ours ms':>9} {'prototype ms':>13} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_prototype(Path(folder))
        for n, width, height in SIZES:
            rows = room(n, width, height)
            runs = [ours(rows, width, height, arguments.threads)]
            if library is not None:
                runs.append(prototype(library, rows, width, height, arguments.threads))
                if np.abs(runs[0]() - runs[1]()).mean() > 1e-3:
                    sys.exit("the two renderings differ: the times mean nothing.")
            mine, *theirs = medians_ms(runs, arguments.repeats)
            other = (
                f"{theirs[0]:13.2f} {mine / theirs[0]:6.2f}" if theirs else f"{'-':>13} {'-':>6}"
            )
            print(f"{n:>10} {f'{width}x{height}':>9} {mine:9.2f} {other}")


if __name__ == "__main__":
    main()
