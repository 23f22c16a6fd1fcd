"""ldo run"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, load_config
from ldo_service.errors import ConfigError
from ldo_service.recordings.sequence import open_source
from ldo_service.runs.folder import prepare
from ldo_service.runs.over_file import Selection, run_over_file

from .options import ConfigFile, Overwrite, Settings, Source
from .progress import progress


def run(
    source: Source,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="folder for the results")],
    config: ConfigFile = None,
    set: Settings = (),
    max_frames: Annotated[
        int | None, tyro.conf.arg(metavar="N", help="stop after so many frames")
    ] = None,
    stride: Annotated[int, tyro.conf.arg(metavar="N", help="take every n-th frame")] = 1,
    hold_out: Annotated[
        int,
        tyro.conf.arg(metavar="N", help="track every n-th frame and never map it; 0: map all"),
    ] = 0,
    threads: Annotated[
        int, tyro.conf.arg(metavar="T", help="of the renderer; 0: all cores but one")
    ] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Track and map a sequence; write trajectory, map and figures to a folder.

    The result depends on the frames and the configuration alone, not on the machine's load, and
    needs no ground truth. `ldo eval DIR SOURCE` compares it with one.

      ldo run synthetic:room --out runs/room
      ldo run ~/data/rgbd_dataset_freiburg1_desk --out runs/desk --max-frames 300
    """
    console = Console(stderr=True)
    settings = with_options(load_config(config, set), hold_out, threads)
    selection = selected(stride, max_frames)
    sequence = open_source(source)
    prepare(out, overwrite)
    with progress("run", len(selection.indices(sequence)), console) as advance:
        record = run_over_file(sequence, out, settings, selection, console.print, advance)
    Console().print(summary_table(record.summary, out))


def with_options(config: Config, hold_out: int, threads: int) -> Config:
    """The configuration with what has an option of its own."""
    tracker = replace(config.tracker, hold_out=hold_out) if hold_out else config.tracker
    mapper = replace(config.mapper, threads=threads) if threads else config.mapper
    return replace(config, tracker=tracker, mapper=mapper)


def selected(stride: int, max_frames: int | None) -> Selection:
    if stride < 1 or (max_frames is not None and max_frames < 1):
        raise ConfigError("--stride and --max-frames must be at least 1.")
    return Selection(stride, max_frames)


def summary_table(summary: dict[str, Any], out: Path) -> Table:
    table = Table(title=f"{out}", show_header=False)
    status = summary["status"]
    rows = {
        "frames": f"{summary['frames']} ({summary['frames_rejected']} rejected)",
        "tracking": ", ".join(f"{count} {name}" for name, count in status.items()),
        "keyframes": summary["keyframes"],
        "Gaussians": f"{summary['gaussians']:,}",
        "speed": f"{summary['fps']:.1f} FPS ({summary['wall_s']:.1f} s, input included)",
        "tracker, mapper": " and ".join(
            f"{summary['stage_ms'][name]['p50']:.1f} ms"
            for name in ("tracker", "mapper")
            if name in summary["stage_ms"]
        )
        + " p50",
        "peak memory": f"{summary['peak_rss_mb']:.0f} MB",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    return table
