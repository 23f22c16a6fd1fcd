"""GPU beside the CPU: an optimizer iteration by stages, and whole maps of several sources.

    python -m tests.bench.bench_gpu [SOURCE ...] [--frames N] [--iterations N] [--runs FOLDER]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. The program first compares the results of the GPU with those of the
CPU, and measures nothing if they differ. It prints:

- the stages of an iteration on both devices, and the memory of the GPU;
- for each source the frames per second of the mapper, and PSNR at equal iterations;
- PSNR at equal time: the GPU gets as many more iterations as it is faster.

Without a GPU, the program says what it needs and measures nothing.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from ldo_service.commands.bench import required_gpu
from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import open_sequence
from ldo_service.errors import DeviceError
from ldo_service.evaluation.iteration import bench_camera
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.runs.map_benchmark import MapMeasurement, TrackedSource

from .bench_map_view import default_sources

SIZES = ((320, 240, 14_600), (640, 480, 60_000))  # Width and height in pixels, Gaussians.
REPEATS = 50
MAX_EFFORT = 500  # Iterations per keyframe; more do not improve a map.


def report_iterations() -> None:
    """Print the stages of an iteration for each of SIZES.

    Raises:
        DeviceError: There is no GPU, or its results are wrong.
    """
    gpu = required_gpu()
    # This module imports Triton, which is optional.
    from ldo_service.evaluation.device_iteration import device_times

    print(gpu.name, ", ".join(f"{name} {value}" for name, value in gpu.versions.items()))
    for width, height, n in SIZES:
        times = device_times(gpu.arrays, n, bench_camera(width, height), REPEATS)
        print(f"{width}x{height}, {n} Gaussians, {times.gpu_mb:.0f} MB on the GPU:")
        for stage, gpu_ms in times.gpu_ms.items():
            cpu_ms = times.cpu_ms[stage]
            print(f"  {stage}: CPU {cpu_ms:.2f} ms, GPU {gpu_ms:.2f} ms, {cpu_ms / gpu_ms:.1f}x")


def on_device(config: MapBuilderConfig, device: str) -> MapBuilderConfig:
    return replace(config, optimizer=replace(config.optimizer, device=device))


def report_source(source: str, frames: int, effort: int, runs: Path) -> None:
    """Map a source on both devices, and on the GPU in the time of the CPU.

    Raises:
        DeviceError: The GPU fails.
    """
    config = load_config()
    tracked = TrackedSource.record(open_sequence(source), frames, config, runs, lambda *_: None)
    builder = actor_parameters(config).mapper.builder
    cpu = tracked.measure(on_device(builder, "cpu"), effort)
    gpu = tracked.measure(on_device(builder, "cuda"), effort)
    print(f"{cpu.source}: {cpu.frames} frames, {cpu.keyframes} keyframes")
    print("  CPU:", text_of(cpu))
    print("  GPU, equal iterations:", text_of(gpu), f"({gpu.fps / cpu.fps:.1f}x)")
    more = min(MAX_EFFORT, equal_time_effort(cpu, gpu))
    print("  GPU, equal time:", text_of(tracked.measure(on_device(builder, "cuda"), more)))


def equal_time_effort(cpu: MapMeasurement, gpu: MapMeasurement) -> int:
    """Return the effort per keyframe with which the GPU takes as long as the CPU."""
    others_ms = gpu.cpu_ms["all"] - gpu.cpu_ms["iterations"]
    free_ms = max(0.0, cpu.cpu_ms["all"] - others_ms)
    return max(1, round(gpu.effort * free_ms / gpu.cpu_ms["iterations"]))


def text_of(found: MapMeasurement) -> str:
    return (
        f"{found.fps:.2f} FPS, {found.iterations} iterations, {found.gaussians} Gaussians, "
        f"{found.online.mean_psnr_db:.2f} dB, {found.online.mean_depth_l1_cm:.2f} cm"
    )


def main() -> int:
    """Run the benchmark, and return the exit status: 1 if a GPU exists and is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--runs", type=Path)
    arguments = parser.parse_args()
    try:
        required_gpu()
    except DeviceError as error:
        print(error)
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        runs = arguments.runs or Path(temporary)
        try:
            report_iterations()
            for source in arguments.sources or default_sources():
                report_source(source, arguments.frames, arguments.iterations, runs)
        except DeviceError as error:
            print(error)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
