"""ldo demo"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.config import load_config
from ldo_service.datasets import Cached, Sequence, open_sequence
from ldo_service.evaluation.pictures import (
    contact_sheet,
    depth_picture,
    save_picture,
    trajectory_picture,
)
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.evaluation.views import Judged, RenderedView, view_of
from ldo_service.runs.finished import read_run
from ldo_service.runs.folder import RunFolder, prepare
from ldo_service.runs.job import Job
from ldo_service.runs.over_file import run_over_file
from ldo_service.runs.source import Selection

from .options import Overwrite
from .progress import progress
from .run import with_options

SOURCE = "synthetic:room"
HOLD_OUT = 5  # every 5th frame is tracked and never mapped
SHEET_ROWS = 3


def demo(
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="folder for the results")] = Path(
        "runs/demo"
    ),
    overwrite: Overwrite = False,
) -> None:
    """Track and map a built-in synthetic room, and judge the result by its exact truth.

    Ends with a table and two pictures. The frames are ray cast, not splatted, and every fifth is
    kept from the map: the PSNR is that of views that the map was not made from.
    """
    console = Console(stderr=True)
    sequence = Cached(open_sequence(SOURCE))
    prepare(out, overwrite)
    with progress("ray casting", len(sequence), console) as advance:
        for index in range(len(sequence)):
            sequence.read(index)
            advance(index + 1)
    config = with_options(load_config(), hold_out=HOLD_OUT, threads=None)
    job = Job(sequence, out, config, Selection(), console.print)
    with progress("tracking and mapping", job.work, console) as advance:
        record = run_over_file(job, advance)
    views = list(held_out_views(out, sequence, config.mapper.thread_count()))
    save_pictures(out, record, sequence, views)
    Console(highlight=False).print(table(record, sequence, views, out))


def held_out_views(out: Path, sequence: Sequence, threads: int) -> Iterator[RenderedView]:
    """Held-out frames with the final map rendered at their final poses, as `ldo eval` does."""
    run = read_run(out)
    (posed,) = run.maps
    for frame in Judged.of(run.frames).held_out:
        if not frame.is_lost:
            yield view_of(sequence[frame.index], posed, frame, threads)


def save_pictures(
    out: Path, record: RunFolder, sequence: Sequence, views: list[RenderedView]
) -> None:
    picture = trajectory_picture(record.final(), sequence.truth())
    save_picture(out / "trajectory.png", picture)
    chosen = views[:: max(1, len(views) // SHEET_ROWS)][:SHEET_ROWS]
    if chosen:
        rows = [
            [
                view.frame.color,
                view.picture,
                depth_picture(view.frame.depth_m),
                depth_picture(view.rendering.median_depth_m),
            ]
            for view in chosen
        ]
        captions = ["camera", "map", "camera depth", "map depth"]
        save_picture(out / "views.png", contact_sheet(rows, captions))


def table(record: RunFolder, sequence: Sequence, views: list[RenderedView], out: Path) -> Table:
    summary, truth = record.summary, sequence.truth()
    rows = {
        "frames": f"{summary['frames']} of {sequence.camera.width}x{sequence.camera.height}",
        "tracking": ", ".join(f"{count} {name}" for name, count in summary["status"].items()),
    }
    if truth is not None:
        for name, trajectory in (("online", record.online()), ("final", record.final())):
            rmse_m = evaluate_trajectory(trajectory, truth).ate_m.rmse
            rows[f"ATE RMSE, {name}"] = f"{100 * rmse_m:.2f} cm"
    rows["map"] = f"{summary['gaussians']:,} Gaussians from {summary['keyframes']} keyframes"
    if views:
        mean_db = np.mean([view.psnr_db for view in views])
        rows["PSNR"] = f"{mean_db:.1f} dB over {len(views)} held-out frames"
    rows["speed"] = f"{summary['fps']:.1f} FPS ({summary['isa']}, ray casting apart)"
    rows["pictures"] = f"{out / 'views.png'}, {out / 'trajectory.png'}"
    printed = Table(title="LDO-SLAM demo", show_header=False)
    for name, value in rows.items():
        printed.add_row(name, value)
    return printed
