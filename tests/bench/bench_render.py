"""Time of one iteration of the optimiser, and against the prototype that set the bar.

    LDO_SKETCHES=.../sketches python tests/bench/bench_render.py [--repeats 30] [--threads 1]

Without LDO_SKETCHES the prototype is left out. Both run in turns in this process, so that other
work on the machine slows both: read the ratio, not the milliseconds. The prototype is compiled
here with the flags of its README, and the instruction sets are matched through LDO_ISA.

`render` is what the service shows: colour, depth, median depth, opacity. The other rows are one
iteration: forward (no median), loss with its derivative, backward to the parameters and the pose,
Adam. The prototype's Adam is part of its backward; its loss is given the windowed means of the
frame, which ours computes.
"""

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ldo_service.kernels import _adam, _loss, _rasterise

SIZES = ((100_000, 640, 480), (100_000, 320, 240), (500_000, 640, 480))
T_CAMERA_MAP = np.eye(4, dtype=np.float32)[:3]
RATES = np.array([1e-4] * 3 + [1e-3] * 10 + [1e-3] + [0] * 2, np.float32)
BETA1, BETA2, EPSILON = 0.9, 0.95, 1e-15
Steps = dict[str, Callable[[], object]]


def room(n: int, width: int, height: int, seed: int = 0) -> np.ndarray:
    """Rows of n flat Gaussians on the walls of a room, each about as wide as its share of pixels;
    a tenth of them lies beyond the edges of the image."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.65, 0.65, n), rng.uniform(-0.5, 0.5, n)
    z = np.minimum(4, np.minimum(1.5 / np.abs(y).clip(0.01), 2.2 / np.abs(x).clip(0.01)))
    z *= 1 + 0.02 * rng.standard_normal(n)
    sigma = 0.9 * z * np.sqrt(width * height / n) / (0.82 * width)
    rows = aligned((n, 16))
    rows[:, :3] = np.stack([x * z, y * z, z], -1)
    rows[:, 3:6] = np.log(sigma[:, None] * [1, 1, 0.2] * rng.uniform(0.6, 1.5, (n, 3)))
    rows[:, 6:10] = rng.standard_normal((n, 4))
    rows[:, 10] = rng.uniform(0, 4, n)
    rows[:, 11:14] = rng.uniform(0, 1, (n, 3))
    return rows


def aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, float32, on a cache line."""
    memory = np.zeros(int(np.prod(shape)) + 16, np.float32)
    skip = (-memory.ctypes.data % 64) // 4
    return memory[skip : skip + int(np.prod(shape))].reshape(shape)


def target(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame: colour planes [3, H, W] uint8 and depth [H, W] with holes."""
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(1, 4, (height, width)).astype(np.float32)
    depth_m[rng.uniform(size=depth_m.shape) < 0.2] = 0
    return rng.integers(0, 256, (3, height, width), np.uint8), depth_m


def intrinsics(width: int, height: int) -> tuple[float, float, float, float]:
    return 0.82 * width, 0.82 * width, (width - 1) / 2, (height - 1) / 2


def ours(rows: np.ndarray, width: int, height: int, threads: int) -> Steps:
    camera = intrinsics(width, height)
    rows = rows.copy() if rows.ctypes.data % 64 else rows
    color, depth_m = target(width, height)
    forward, planes, gradients = _rasterise.Pass(), *(aligned((5, height, width)) for _ in "ab")
    exposure = np.array([[1, 1, 1], [0, 0, 0]], np.float32)
    moments, steps = [aligned(rows.shape) for _ in "ab"], np.zeros(len(rows), np.int32)
    indices, by_row = np.zeros(len(rows), np.uint32), aligned(rows.shape)
    seen, memory = slice(0, 0), _rasterise.Pass()

    def render() -> np.ndarray:
        return _rasterise.rasterise(rows, T_CAMERA_MAP, *camera, width, height, threads, memory)[0]

    def rasterise() -> np.ndarray:
        nonlocal seen
        seen = slice(
            _rasterise.rasterise_planes(forward, rows, T_CAMERA_MAP, *camera, planes, threads)
        )
        return planes

    def loss() -> np.ndarray:
        _loss.image_loss(planes, color, depth_m, None, exposure, 0.8, 0.2, 1.0, gradients, threads)
        return gradients

    def backward() -> None:
        _rasterise.backpropagate(
            forward, rows, planes, gradients, indices[seen], by_row[seen], 0.0, 0.0, threads
        )

    def adam() -> None:
        _adam.adam_step(
            rows,
            *moments,
            steps,
            indices[seen],
            by_row[seen],
            RATES,
            BETA1,
            BETA2,
            EPSILON,
            threads,
        )

    return {
        "render": render,
        "forward": rasterise,
        "loss": loss,
        "backward": backward,
        "adam": adam,
    }


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
    out.rc_loss.restype = ctypes.c_double
    return out


def prototype(
    library: ctypes.CDLL, rows: np.ndarray, width: int, height: int, threads: int
) -> Steps:
    camera = np.array([*np.eye(3).ravel(), 0, 0, 0, *intrinsics(width, height)], np.float32)
    rows = rows + aligned(rows.shape)
    color, depth_m = target(width, height)
    color = (color / 255).astype(np.float32)
    planes, gradients = aligned((5, height, width)), aligned((5, height, width))
    statistics, parts = np.zeros((6, height, width), np.float32), np.zeros(4)
    moments = [aligned(rows.shape) for _ in "ab"]
    context = ctypes.c_void_p(library.rc_new())
    number = ctypes.c_float

    def at(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    library.rc_threads(threads)
    library.rc_gtstats(at(color), width, height, at(statistics))

    def forward() -> np.ndarray:
        library.rc_forward(context, len(rows), at(rows), at(camera), width, height, at(planes), 0)
        return planes

    def loss() -> np.ndarray:
        images = (at(planes), at(color), at(depth_m), at(statistics))
        size = (width, height, number(0.2), number(1.0))
        library.rc_loss(context, *images, *size, at(gradients), at(parts))
        return gradients

    def backward() -> None:  # and Adam
        library.rc_backward_tiles(context, at(planes), at(gradients))
        beta_and_step = (number(BETA1), number(BETA2), number(EPSILON), 10)
        library.rc_backward_params(
            context, at(rows), None, *map(at, moments), at(RATES), *beta_and_step
        )

    def render() -> np.ndarray:
        return forward()[:3].transpose(1, 2, 0)

    return {"render": render, "forward": forward, "loss": loss, "backward": backward}


def medians_ms(
    runs: list[Steps], repeats: int, clock: Callable[[], float]
) -> list[dict[str, float]]:
    """Of each step, run in turns, after one turn to warm up."""
    times: list[dict[str, list[float]]] = [{name: [] for name in steps} for steps in runs]
    for _ in range(repeats + 1):
        for steps, lists in zip(runs, times, strict=True):
            for name, step in steps.items():
                start = clock()
                step()
                lists[name].append(clock() - start)
    out = []
    for lists in times:
        whole = sum(np.array(lists[name][1:]) for name in lists if name != "render")
        medians = {name: float(np.median(values[1:])) * 1e3 for name, values in lists.items()}
        out.append(medians | {"iteration": float(np.median(whole)) * 1e3})
    return out


def check_agreement(mine: Steps, theirs: Steps) -> None:
    """Leave if the two compute something else: then the times mean nothing."""
    for name, tolerance in (("render", 1e-3), ("forward", 2e-3), ("loss", 1e-8)):
        a, b = mine[name](), theirs[name]()
        assert isinstance(a, np.ndarray)
        assert isinstance(b, np.ndarray)
        if name == "forward":  # the prototype's last plane is the transmittance
            a, b = a[:4], b[:4]
        if name == "loss":  # its depth loss counts the pixels without depth
            a, b = a[:3], b[:3]
        if np.abs(a - b).mean() > tolerance:
            sys.exit(f"the two differ in {name}: the times mean nothing.")


def report(n: int, size: str, mine: dict[str, float], theirs: dict[str, float] | None) -> None:
    for name, time_ms in mine.items():
        other = theirs and theirs.get(name)
        theirs_ms = f"{other:13.2f} {time_ms / other:6.2f}" if other else f"{'-':>13} {'-':>6}"
        print(f"{n:>10} {size:>9} {name:>10} {time_ms:9.2f} {theirs_ms}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--sizes", type=int, default=len(SIZES), help="how many of the scenes")
    parser.add_argument("--cpu", action="store_true", help="CPU time, for a busy machine")
    parser.add_argument("--json", action="store_true", help="one line of JSON per scene")
    arguments = parser.parse_args()
    isa, threads = _rasterise.isa(), arguments.threads
    clock = time.process_time if arguments.cpu else time.perf_counter
    if not arguments.json:
        print(f"isa {isa}, {threads} thread(s), median of {arguments.repeats}")
        print(
            f"{'Gaussians':>10} {'image':>9} {'step':>10} {'ours ms':>9} {'prototype ms':>13} ratio"
        )
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_prototype(Path(folder))
        for n, width, height in SIZES[: arguments.sizes]:
            rows = room(n, width, height)
            runs = [ours(rows, width, height, threads)]
            if library is not None:
                runs.append(prototype(library, rows, width, height, threads))
                check_agreement(*runs)
            mine, *theirs = medians_ms(runs, arguments.repeats, clock)
            if arguments.json:
                facts = {"gaussians": n, "width": width, "height": height, "isa": isa}
                times = {f"{name}_ms": time_ms for name, time_ms in mine.items()}
                print(json.dumps(facts | {"threads": threads} | times))
            else:
                report(n, f"{width}x{height}", mine, theirs[0] if theirs else None)


if __name__ == "__main__":
    main()
