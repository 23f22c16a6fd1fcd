"""Command `ldo demo`: track, map and label a built-in synthetic room, and evaluate the result."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, actor_parameters, load_config
from ldo_service.evaluation.results import Results, evaluate_run, work
from ldo_service.runs.finished import read_run
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.records import read_objects
from ldo_service.runs.source import Selection
from ldo_service.schemas import MapObjects
from ldo_service.synthetic import FlatSequence
from ldo_service.synthetic.flat.sequence import prerender

from .options import Overwrite, argument, note_console, progress
from .run import execute, with_options

FRAMES = 70  # The first frames of the synthetic flat, which show its first room.
HOLD_OUT = 5  # Every 5th frame is tracked but not mapped.
PROCESSES = 4  # Maximum ray-casting processes; each takes seconds to start, then 1 s per frame.
NETWORKS = "demo"  # Name of the networks that come with the package.


def demo(
    out: Annotated[Path, argument(metavar="DIR", help="folder for the results")] = Path(
        "runs/demo"
    ),
    overwrite: Overwrite = False,
) -> None:
    """Track, map and label a built-in synthetic room, and compare the result with ground truth.

    The command prints a table and writes three pictures. The frames are made by ray casting, with
    the blur and the depth noise of a Kinect. Every fifth frame is tracked but not mapped, and the
    PSNR is measured on these held-out frames.

    The names of objects come from small networks in the package. These networks were trained on
    other synthetic rooms and recognize objects in synthetic rooms only. The settings that separate
    objects by depth were tuned on this room.
    """
    console = note_console()
    sequence = FlatSequence.named("flat")
    prepare(out, overwrite)
    with progress("ray casting", FRAMES, console) as advance:
        prerender(sequence.config, min(os.cpu_count() or 1, PROCESSES), range(FRAMES), advance)
    job = RunOptions(sequence, out, demo_config(), Selection(max_frames=FRAMES), console.print)
    record = execute(job, run_offline, console, "tracking and mapping")
    run, threads = read_run(out), actor_parameters(job.config).mapper.thread_count()
    with progress("evaluating", work(run, sequence), console) as advance:
        results = evaluate_run(run, sequence, advance, threads=threads)
    printed = Table(title="LDO-SLAM demo", show_header=False)
    size = f"{sequence.camera.width}x{sequence.camera.height}"
    for row in rows(record.summary, size, results, read_objects(out)):
        printed.add_row(*row)
    Console(highlight=False, markup=False).print(printed)


def demo_config() -> Config:
    config = with_options(load_config(), hold_out=HOLD_OUT, threads=None)
    return replace(
        config,
        detector=replace(config.detector, model=NETWORKS),
        vlm_labeller=replace(config.vlm_labeller, model=NETWORKS),
    )


def rows(
    summary: dict[str, Any], size: str, results: Results, found: MapObjects
) -> Iterator[tuple[str, str]]:
    """Yield the names and values of the printed table.

    Args:
        summary: Content of summary.json of the run.
        size: Size of a frame, such as 640x480, pixels.
        results: Comparison of the run with ground truth.
        found: Objects of the map.
    """
    yield "frames", f"{summary['frames']} of {size}"
    yield "tracking", ", ".join(f"{count} {name}" for name, count in summary["status"].items())
    for name, errors in (results.trajectories or {}).items():
        yield f"ATE RMSE, {name}", f"{100 * errors.ate_m.rmse:.2f} cm"
    yield "map", f"{summary['gaussians']:,} Gaussians from {summary['keyframes']} keyframes"
    for judged in results.renderings[:1]:
        psnr_db = judged.mean("psnr_db")
        yield "PSNR", f"{psnr_db:.1f} dB over {len(judged.views)} held-out frames"
    yield "objects", ", ".join(sorted(one.name for one in found.objects)) or "none"
    for errors in results.labels:
        right = errors.lists[0].figures(gate=0.0).pixel_accuracy
        yield "labels", f"{right:.0%} of the pixels have the right label (COCO or background)"
    yield "speed", f"{summary['fps']:.1f} FPS ({summary['isa']}, without ray casting)"
    yield "pictures", "\n".join(map(str, results.pictures))
