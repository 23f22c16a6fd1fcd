"""Command `ldo bench`: measure the speed of the Gaussian optimizer, or of the mapper."""

import json
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro
from rich.console import Console
from rich.table import Column, Table

from ldo_service import kernels
from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DeviceError
from ldo_service.evaluation.iteration import Iteration, bench_camera, iteration_times
from ldo_service.geometry import Camera
from ldo_service.kernels.gpu.benchmark_result import BenchmarkResult, result_file, save_result
from ldo_service.kernels.gpu.device import MIN_CAPABILITY, Gpu, find_gpu
from ldo_service.runs.map_benchmark import HeldOutErrors, MapMeasurement, TrackedSource

from .options import (
    ConfigFile,
    Settings,
    Source,
    argument,
    image_size,
    note_console,
    progress,
    with_device,
)

Json = Annotated[bool, argument(name="json", help="print one JSON object")]


@dataclass(frozen=True)
class BenchRender:
    """Measure how long one iteration of the Gaussian optimizer takes on this machine.

    The scene is synthetic. The times are medians over all repeats, in milliseconds of wall time.
    Adam updates the Gaussians inside the backward pass. adam_ms is the time that this update adds,
    and backward_ms is the time of the backward pass without the update. iteration_ms is the time of
    forward pass, loss, backward pass and update together.
    """

    gaussians: Annotated[int, argument(help="Gaussians in view")] = 100_000
    gaussians_out_of_view: Annotated[int, argument(help="additional Gaussians out of view")] = 0
    size: Annotated[str, argument(metavar="WxH", help="size of the image, pixels")] = "640x480"
    threads: Annotated[
        int | None,
        argument(
            metavar="T",
            help="threads of the kernels; default: 1, or with --device cuda all cores of the CPU, "
            "as in the mapper",
        ),
    ] = None
    repeats: Annotated[int, argument(help="iterations; the times are medians over them")] = 20
    json_: Json = False


@dataclass(frozen=True)
class BenchMap:
    """Measure the mapper alone on a source: frames per second, CPU time per step, and errors.

    The source is tracked once. Its keyframes are then mapped at their final poses on one thread, so
    that the tracker does not affect a comparison of settings. FPS is the number of frames per CPU
    second of the mapper. PSNR and depth L1 are those of every fifth frame, which is held out; the
    exposure of such a frame is interpolated between keyframes.

    CPU times depend on what else the machine does. To compare two settings, run both commands at
    the same time, or one directly after the other.

      ldo bench map ~/data/kitchen --frames 200 --runs build/bench --save sharp.json
      ldo bench map ~/data/kitchen --frames 200 --runs build/bench --baseline sharp.json
    """

    source: Source
    frames: Annotated[int, argument(metavar="N", help="number of frames")] = 60
    config: ConfigFile = None
    set: Settings = ()
    refine_iterations: Annotated[
        int, argument(metavar="N", help="measure the map after N more iterations too")
    ] = 0
    runs: Annotated[
        Path | None,
        argument(
            metavar="DIR",
            help="folder in which the tracked source is kept for later calls; default: a temporary "
            "folder",
        ),
    ] = None
    save: Annotated[
        Path | None, argument(metavar="FILE", help="store the measurement as a baseline")
    ] = None
    baseline: Annotated[
        Path | None,
        argument(metavar="FILE", help="print the ratio to a measurement stored with --save"),
    ] = None
    json_: Json = False


Verb = (
    Annotated[BenchRender, tyro.conf.subcommand("render")]
    | Annotated[BenchMap, tyro.conf.subcommand("map")]
)


@tyro.conf.configure(tyro.conf.CascadeSubcommandArgs)
def bench(
    verb: Verb = BenchRender(),
    device: Annotated[
        Literal["cpu", "cuda"],
        argument(help="cuda: measure a GPU, and for `render` the CPU too (experimental)"),
    ] = "cpu",
) -> None:
    """Measure the speed of the Gaussian optimizer, or of the mapper on a source.

    Set the environment variable LDO_ISA to avx512, avx2 or baseline to choose the instruction set.
    With --device cuda, the command first compares the results of the GPU with those of the CPU. If
    they differ, it measures nothing. If they agree, `ldo bench render` measures an iteration of the
    optimizer and the alignment of a frame on both devices. It saves the result in the user's cache
    folder (LDO_CACHE). With service.device=auto, mapper and tracker use the device that was faster
    in the last saved result.

      ldo bench
      ldo bench --device cuda
    """
    match verb:
        case BenchRender():
            bench_render(verb, device)
        case BenchMap():
            bench_map(verb, device)


def bench_render(verb: BenchRender, device: str = "cpu") -> None:
    """Measure one iteration of the Gaussian optimizer, and print the times of its steps.

    Raises:
        ConfigError: A number is out of range.
        DeviceError: The device is cuda, but no GPU is available, or its results are wrong.
    """
    width, height = image_size(verb.size)
    cores = os.cpu_count() or 1
    threads = (cores if device == "cuda" else 1) if verb.threads is None else verb.threads
    if not min(verb.gaussians, threads, verb.repeats) >= 1:
        raise ConfigError(
            f"--gaussians {verb.gaussians}, --threads {threads} and --repeats {verb.repeats} "
            "must each be at least 1."
        )
    if verb.gaussians_out_of_view < 0:
        raise ConfigError(
            f"--gaussians-out-of-view {verb.gaussians_out_of_view} must be at least 0."
        )
    camera = bench_camera(width, height)
    if device == "cuda":
        bench_gpu_render(verb, camera, threads)
        return
    iteration = Iteration(
        verb.gaussians, camera, threads=threads, elsewhere=verb.gaussians_out_of_view
    )
    times = asdict(iteration_times(iteration, verb.repeats))
    facts = {
        "isa": kernels.isa(),
        "gaussians": verb.gaussians,
        "gaussians_out_of_view": verb.gaussians_out_of_view,
        "width": width,
        "height": height,
        "threads": threads,
    }
    if verb.json_:
        print(json.dumps(times | facts))
    else:
        console = Console(highlight=False)
        console.print("render: " + ", ".join(f"{name} {fact}" for name, fact in facts.items()))
        console.print(_table(times))


def bench_gpu_render(verb: BenchRender, camera: Camera, threads: int) -> None:
    """Measure one iteration on a GPU and on the CPU, print the times side by side, and save them.

    A failure of the GPU is saved too, so that an earlier result does not select this GPU.

    Raises:
        ConfigError: An option applies to the CPU alone, or the result cannot be saved.
        DeviceError: There is no GPU, or its results are wrong.
    """
    if verb.gaussians_out_of_view:
        raise ConfigError("--gaussians-out-of-view applies to --device cpu alone. Remove it.")
    gpu = required_gpu()
    # This module imports Triton, which is optional.
    from ldo_service.evaluation.device_iteration import device_times

    result = BenchmarkResult(
        gpu=gpu.name,
        versions=gpu.versions_and_ours,
        scene=f"{camera.width}x{camera.height} pixels, {verb.gaussians} Gaussians, {threads} "
        "threads of the CPU",
    )
    try:
        times = device_times(gpu.arrays, verb.gaussians, camera, verb.repeats, threads=threads)
    except DeviceError as error:
        try:
            save_result(msgspec.structs.replace(result, error=str(error)))
        except ConfigError as not_saved:
            print(f"ldo: {not_saved}", file=sys.stderr)
        raise
    facts = {
        "isa": kernels.isa(),
        "gpu": gpu.name,
        **gpu.versions,
        "gaussians": verb.gaussians,
        "width": camera.width,
        "height": camera.height,
        "threads": threads,
        "gpu_mb": times.gpu_mb,
    }
    if verb.json_:
        print(json.dumps(asdict(times) | facts))
    else:
        _print_both(times.cpu_ms, times.gpu_ms, facts)
    save_result(msgspec.structs.replace(result, cpu_ms=times.cpu_ms, gpu_ms=times.gpu_ms))
    if not verb.json_:
        print(f"saved in {result_file()}; service.device=auto chooses the faster device")


def _print_both(cpu_ms: dict[str, float], gpu_ms: dict[str, float], facts: dict[str, Any]) -> None:
    console = Console(highlight=False)
    console.print("render: " + ", ".join(f"{name} {fact}" for name, fact in facts.items()))
    columns = [Column(name, justify="right") for name in ("CPU ms", "GPU ms", "CPU / GPU")]
    table = Table("step", *columns)
    for name, on_gpu in gpu_ms.items():
        ratio = cpu_ms[name] / on_gpu
        table.add_row(name, f"{cpu_ms[name]:.2f}", f"{on_gpu:.2f}", f"{ratio:.2f}")
    console.print(table)


def required_gpu() -> Gpu:
    """Return the GPU of this machine.

    Raises:
        DeviceError: The machine has no suitable GPU. The message states the requirements.
    """
    try:
        return find_gpu()
    except DeviceError as error:
        raise DeviceError(
            "the benchmark with --device cuda needs a GPU of NVIDIA with compute capability "
            f"{MIN_CAPABILITY / 10:.1f} or higher, its driver, and the extra cuda: {error}"
        ) from error


def bench_map(verb: BenchMap, device: str = "cpu") -> None:
    """Measure the mapper on a source, and print the result beside a stored baseline.

    Raises:
        ConfigError: A number is out of range, or the baseline has other frames.
        DeviceError: The device is cuda, but no GPU is available, or its results are wrong.
    """
    if verb.frames < 2 or verb.refine_iterations < 0:
        raise ConfigError(
            f"--frames {verb.frames} must be at least 2, and --refine-iterations "
            f"{verb.refine_iterations} must be at least 0."
        )
    baseline = read_baseline(verb.baseline) if verb.baseline else None
    config = load_config(verb.config, verb.set)
    if device == "cuda":
        required_gpu()
        config = with_device(config, device)
    sequence, mapper = open_sequence(verb.source), actor_parameters(config).mapper
    with tempfile.TemporaryDirectory() as temporary:
        runs = (verb.runs or Path(temporary)).expanduser()
        with progress("track", min(verb.frames, len(sequence)), note_console()) as advance:
            tracked = TrackedSource.record(sequence, verb.frames, config, runs, advance)
        found = tracked.measure(mapper.builder, mapper.iterations, verb.refine_iterations)
    if baseline:
        require_comparable(found, baseline)
    if verb.save:
        save_baseline(verb.save, found)
    if verb.json_:
        print(json.dumps(_facts(found, baseline)))
    else:
        console = Console(highlight=False)
        console.print(
            f"map: {found.source}, {found.frames} frames, {found.keyframes} keyframes, effort "
            f"{found.effort} per keyframe, {found.iterations} iterations, {found.gaussians} "
            f"Gaussians, isa {kernels.isa()}"
        )
        console.print(measurement_table(found, baseline))


def save_baseline(path: Path, measured: MapMeasurement) -> None:
    """Write a measurement to a file.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        path.expanduser().write_bytes(msgspec.json.format(msgspec.json.encode(measured)) + b"\n")
    except OSError as error:
        raise ConfigError(
            f"--save {path} cannot be written: {error.strerror}. Choose another file."
        ) from error


def read_baseline(path: Path) -> MapMeasurement:
    """Read a measurement that `save_baseline` has written.

    Raises:
        ConfigError: The file cannot be read, or it is no such measurement.
    """
    try:
        return msgspec.json.decode(path.expanduser().read_bytes(), type=MapMeasurement)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        problem = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"--baseline {path} cannot be read: {problem}. Give a file that `ldo bench map --save` "
            "has written."
        ) from error


def require_comparable(measured: MapMeasurement, baseline: MapMeasurement) -> None:
    """Check that two measurements have the same keyframes.

    Raises:
        ConfigError: Source, frames or keyframes differ.
    """
    ours, theirs = ((m.source, m.frames, m.keyframes) for m in (measured, baseline))
    if ours != theirs:
        raise ConfigError(
            f"--baseline has {theirs[2]} keyframes in {theirs[1]} frames of {theirs[0]}, but this "
            f"measurement has {ours[2]} keyframes in {ours[1]} frames of {ours[0]}. Make a new "
            "baseline with --save."
        )


def measurement_table(found: MapMeasurement, baseline: MapMeasurement | None) -> Table:
    """Return a table of a measurement; a given baseline adds columns for its values and ratios."""
    table = Table("", Column("measured", justify="right"))
    if baseline:
        for name in ("baseline", "ratio"):
            table.add_column(name, justify="right")
    theirs = _figures(baseline) if baseline else {}
    for name, value in _figures(found).items():
        row = [f"{value:.2f}"]
        if name in theirs:
            before = theirs[name]
            row += [f"{before:.2f}", f"{value / before:.2f}" if before else ""]
        table.add_row(name, *row)
    return table


def _figures(measured: MapMeasurement) -> dict[str, float]:
    figures = {"FPS": measured.fps}
    figures |= {f"{stage}, CPU ms per keyframe": ms for stage, ms in measured.cpu_ms.items()}
    figures |= _error_figures("", measured.online)
    if measured.refined:
        figures["refinement, CPU s"] = measured.refinement_cpu_s
        figures |= _error_figures("refined ", measured.refined)
    return figures


def _error_figures(prefix: str, errors: HeldOutErrors) -> dict[str, float]:
    return {
        f"{prefix}PSNR dB, mean": errors.mean_psnr_db,
        f"{prefix}PSNR dB, median": errors.median_psnr_db,
        f"{prefix}depth L1 cm, mean": errors.mean_depth_l1_cm,
        f"{prefix}depth L1 cm, median": errors.median_depth_l1_cm,
    }


def _facts(found: MapMeasurement, baseline: MapMeasurement | None) -> dict[str, Any]:
    facts = {**msgspec.to_builtins(found), "isa": kernels.isa()}
    if baseline:
        facts["cpu_ratio"] = found.cpu_ms["all"] / baseline.cpu_ms["all"]
        facts["psnr_gain_db"] = found.online.mean_psnr_db - baseline.online.mean_psnr_db
    return facts


def _table(times: dict[str, float]) -> Table:
    table = Table("step", Column("ms", justify="right"))
    for name, time_ms in times.items():
        table.add_row(name.removesuffix("_ms"), f"{time_ms:.2f}")
    return table
