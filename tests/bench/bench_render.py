"""Time of one iteration of the Gaussian optimizer, compared with the prototype.

    LDO_SKETCHES=.../sketches python tests/bench/bench_render.py [--repeats 30] [--threads 1]

Without LDO_SKETCHES only our code runs. Both run in turns in this process, so that other work on
the machine slows both: read the ratio, not the milliseconds. The prototype is compiled here with
the flags of its README, for the instruction set that LDO_ISA selects. For AVX2 it is compiled
without AVX-512, as `-march=native` would give it the 32 registers and masks of AVX-512 where they
exist.

`render` is the rendering of the service: color, depth, median depth and opacity. The other rows are
the steps of one iteration: forward (no median), loss with its derivative, and descent. Descent is
the backward pass to the parameters and the pose, with a step of Adam. The prototype's loss receives
the windowed means of the frame, which ours computes. `ldo bench render` measures the same scene and
steps without a prototype.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from ldo_service.evaluation.iteration import (
    Iteration,
    Steps,
    bench_camera,
    medians_ms,
    noise_frame,
)
from ldo_service.gaussians import render
from ldo_service.gaussians.renderer import RenderMemory
from ldo_service.geometry import Camera
from ldo_service.kernels import _rasterize
from tests.reference.render import render_reference

SIZES = ((100_000, 640, 480), (100_000, 320, 240), (500_000, 640, 480))
RATES = np.array([1e-4] * 3 + [1e-3] * 10 + [1e-3] + [0] * 2, np.float32)
BETA1, BETA2, EPSILON = 0.9, 0.95, 1e-15


def aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Return float32 zeros that start on a cache line."""
    memory = np.zeros(int(np.prod(shape)) + 16, np.float32)
    skip = (-memory.ctypes.data % 64) // 4
    return memory[skip : skip + int(np.prod(shape))].reshape(shape)


def ours(iteration: Iteration) -> Steps:
    memory = RenderMemory()

    def show() -> np.ndarray:
        return render(
            iteration.gaussians.rows,
            iteration.camera,
            np.eye(4),
            threads=iteration.threads,
            bounds=iteration.gaussians.bounds,
            memory=memory,
        ).color

    return {"render": show} | iteration.steps()


def compiled_prototype(folder: Path) -> ctypes.CDLL | None:
    sketches = os.environ.get("LDO_SKETCHES")
    if not sketches or _rasterize.isa() == "baseline":
        return None
    library = folder / "prototype.so"
    machine = ["-march=x86-64-v3", "-DNO512"] if _rasterize.isa() == "avx2" else ["-march=native"]
    flags = ["-O3", *machine, "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
    source = Path(sketches) / "raster" / "rast.cpp"
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    out = ctypes.CDLL(str(library))
    out.rc_new.restype = ctypes.c_void_p
    out.rc_loss.restype = ctypes.c_double
    return out


def prototype(library: ctypes.CDLL, rows: np.ndarray, view: Camera, threads: int) -> Steps:
    width, height = view.width, view.height
    intrinsics = view.fx, view.fy, view.cx, view.cy
    camera = np.array([*np.eye(3).ravel(), 0, 0, 0, *intrinsics], np.float32)
    rows = rows + aligned(rows.shape)
    color, depth_m = noise_frame(view)
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

    def descent() -> None:
        library.rc_backward_tiles(context, at(planes), at(gradients))
        beta_and_step = (number(BETA1), number(BETA2), number(EPSILON), 10)
        library.rc_backward_params(
            context, at(rows), None, *map(at, moments), at(RATES), *beta_and_step
        )

    def render() -> np.ndarray:
        return forward()[:3].transpose(1, 2, 0)

    return {"render": render, "forward": forward, "loss": loss, "descent": descent}


def check_agreement(mine: Steps, theirs: Steps) -> None:
    """Exit if the two compute different results, as their times are then not comparable."""
    for name, tolerance in (("render", 1e-3), ("forward", 2e-3), ("loss", 1e-8)):
        a, b = mine[name](), theirs[name]()
        assert isinstance(a, np.ndarray)
        assert isinstance(b, np.ndarray)
        if name == "forward":  # The prototype's last plane is the transmittance.
            a, b = a[:4], b[:4]
        if name == "loss":  # The prototype's depth loss counts pixels without depth.
            a, b = a[:3], b[:3]
        if np.abs(a - b).mean() > tolerance:
            sys.exit(
                f"the results of {name} differ by more than {tolerance}; times are not comparable."
            )


def report(n: int, size: str, mine: dict[str, float], theirs: dict[str, float] | None) -> None:
    for name, time_ms in mine.items():
        other = theirs.get(name) if theirs else None
        theirs_ms = f"{other:13.2f} {time_ms / other:6.2f}" if other else f"{'-':>13} {'-':>6}"
        print(f"{n:>10} {size:>9} {name:>10} {time_ms:9.2f} {theirs_ms}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--sizes", type=int, default=len(SIZES), help="number of scenes to run")
    parser.add_argument("--cpu", action="store_true", help="measure CPU time, for a busy machine")
    arguments = parser.parse_args()
    isa, threads = _rasterize.isa(), arguments.threads
    clock = time.process_time if arguments.cpu else time.perf_counter
    print(f"isa {isa}, {threads} thread(s), median of {arguments.repeats}")
    print(f"{'Gaussians':>10} {'image':>9} {'step':>10} {'ours ms':>9} {'prototype ms':>13} ratio")
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_prototype(Path(folder))
        for n, width, height in SIZES[: arguments.sizes]:
            iteration = Iteration(n, bench_camera(width, height), threads=threads)
            runs = [ours(iteration)]
            if library is not None:
                rows = iteration.gaussians.rows
                runs.append(prototype(library, rows, iteration.camera, threads))
                check_agreement(*runs)
            mine, *theirs = medians_ms(runs, arguments.repeats, clock)
            report(n, f"{width}x{height}", mine, theirs[0] if theirs else None)
    time_the_reference()


def time_the_reference() -> None:
    """Print the times of the kernel and of the NumPy reference for a small image."""
    iteration = Iteration(300, bench_camera(48, 36))
    rows, camera = iteration.gaussians.rows, iteration.camera
    runs: list[Steps] = [
        {"render": lambda: render(rows, camera, np.eye(4))},
        {"render": lambda: render_reference(rows.astype(float), camera, np.eye(4))},
    ]
    kernel, numpy_ms = medians_ms(runs, repeats=3)
    both = f"kernel {kernel['render']:.2f} ms, NumPy reference {numpy_ms['render']:.0f} ms"
    print(f"300 Gaussians, 48x36: {both}")


if __name__ == "__main__":
    main()
