"""ldo run"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import gcd
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, checked, load_config
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.runs.folder import RunWriter, prepare
from ldo_service.runs.front_end import FrontEnd
from ldo_service.runs.job import Advance, RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.realtime import run_realtime
from ldo_service.runs.source import Selection, open_source

from .options import (
    ConfigFile,
    Localize,
    MaxFrames,
    Overwrite,
    Settings,
    Source,
    Stride,
    localizing,
    progress,
    with_usable_networks,
)


def run(
    source: Source,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="folder for the results")],
    config: ConfigFile = None,
    set: Settings = (),
    max_frames: MaxFrames = None,
    stride: Stride = 1,
    hold_out_every: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", help="track every n-th frame and never map it; 0: map all"),
    ] = None,
    threads: Annotated[
        int | None,
        tyro.conf.arg(
            metavar="T",
            help="of the renderer; 0: all cores, but one for the tracker where frames do not wait",
        ),
    ] = None,
    refine_iterations: Annotated[
        int,
        tyro.conf.arg(
            metavar="N", help="fit the map for N more iterations at the end, into DIR/refined"
        ),
    ] = 0,
    localize: Localize = None,
    odometry_prior: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FILE",
            help="where another odometry had the robot's base, in the TUM format: a guess for the "
            "tracker. tracker.T_base_camera says where the camera sits on it",
        ),
    ] = None,
    keep_front_end: Annotated[
        bool,
        tyro.conf.arg(help="keep what tracker and detector say in DIR/front_end.mcap, images too"),
    ] = False,
    reuse_front_end: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="RUN",
            help="take what they said from this folder of a run over the same frames, and run the "
            "others alone: what their settings are worth, poses being equal",
        ),
    ] = None,
    realtime: Annotated[
        bool, tyro.conf.arg(help="pace by stamps and drop late frames, as the service does")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Track and map a sequence; write trajectory, map and figures to a folder.

    The result depends on the frames and the configuration alone, not on the machine's load, and
    needs no ground truth. `ldo eval DIR SOURCE` compares it with one.

      ldo run synthetic:room --out runs/room
      ldo run ~/data/rgbd_dataset_freiburg1_desk --out runs/desk --max-frames 300
      ldo run ~/data/desk_again --out runs/again --localize runs/desk
      ldo run synthetic:flat --out runs/half --reuse-front-end runs/flat --set mapper.iterations=7
    """
    over_file = {
        "--refine-iterations": refine_iterations,
        "--reuse-front-end": reuse_front_end,
        "--keep-front-end": keep_front_end,
    }
    looking = {
        "--odometry-prior": odometry_prior,
        "--localize": localize,
        "--keep-front-end": keep_front_end,
    }
    require_none_of("--realtime", realtime, over_file)
    require_none_of("--reuse-front-end", reuse_front_end, looking)
    require_none_of("--localize", localize, {"--keep-front-end": keep_front_end})
    require_separate(localize, out, refine_iterations)
    console = Console(stderr=True)
    settings = with_options(load_config(config, set), hold_out_every, threads)
    settings = localizing(settings, localize)
    with_usable_networks(settings)
    selection = Selection(stride, max_frames)
    require_held_out(stride, settings.tracker.hold_out)
    sequence = open_source(source, settings.dataset.options())
    job = RunOptions(
        *(sequence, out, settings, selection, console.print),
        refine=refine_iterations,
        prior=Trajectory.load(odometry_prior) if odometry_prior else None,
        front_end=kept_front_end(reuse_front_end, out, settings, sequence, selection),
        keep_front_end=keep_front_end,
    )
    prepare(out, overwrite)
    record = execute(job, run_realtime if realtime else run_offline, console)
    Console().print(summary_table(record.summary, out))
    if record.summary["gaussians_unmerged"]:
        Console().print(format_unmerged(record.summary["gaussians_unmerged"]), style="dim")
    if localize:
        Console().print(format_localization(record.statuses, localize), style="dim")


def execute(
    job: RunOptions, go: Callable[[RunOptions, Advance], RunWriter], console: Console
) -> RunWriter:
    with progress("run", job.work, console) as advance:
        try:
            return go(job, advance)
        except OSError as error:
            raise ConfigError(
                f"{job.folder} cannot be written: {error.strerror}. Free some space, or choose "
                "another folder; what is there is incomplete."
            ) from error


def kept_front_end(
    run: Path | None, out: Path, settings: Config, sequence: Sequence, selection: Selection
) -> FrontEnd | None:
    if run is None:
        return None
    if run.expanduser().resolve() == out.expanduser().resolve():
        raise ConfigError(f"--out {out} would replace the front end: choose another folder.")
    return FrontEnd.open(run, settings, sequence, selection)


def format_unmerged(gaussians: int) -> str:
    return (
        f"map.ply leaves out {gaussians:,} Gaussians: the camera was lost, went on, and nothing it "
        "saw from then on was recognised, so where they belong is not known."
    )


def format_localization(statuses: dict[str, int], folder: Path) -> str:
    if statuses["OK"] + statuses["WEAK"] == 0:
        return (
            f"No frame was recognised: is {folder} a map of this place, seen from about the same "
            "heights and by a camera as wide?"
        )
    return f"The map is that of {folder}, as it was."


def with_options(config: Config, hold_out: int | None, threads: int | None) -> Config:
    """The configuration with what has an option of its own."""
    tracker, mapper = config.tracker, config.mapper
    if hold_out is not None:
        tracker = replace(tracker, hold_out=hold_out)
    if threads is not None:
        mapper = replace(mapper, threads=threads)
    return checked(replace(config, tracker=tracker, mapper=mapper))


def require_none_of(option: str, is_given: object, others: Mapping[str, object]) -> None:
    """Options that leave an option nothing to do, or would themselves have nothing to do."""
    wrong = [name for name, value in others.items() if value]
    if is_given and wrong:
        raise ConfigError(f"{option} and {wrong[0]} do not go together: leave one of them out.")


def require_separate(localize: Path | None, out: Path, refine: int) -> None:
    """A map that is localised in stays as it is."""
    if localize and refine:
        raise ConfigError("--localize leaves the map as it is: leave out --refine-iterations.")
    if localize and localize.expanduser().resolve() == out.expanduser().resolve():
        raise ConfigError(f"--out {out} would replace the map to localize in: choose another.")


def require_held_out(stride: int, hold_out: int) -> None:
    """Held-out frames are counted in the sequence: with a common factor some would never come."""
    if hold_out and gcd(stride, hold_out) > 1:
        raise ConfigError(
            f"--stride {stride} and --hold-out-every {hold_out} share a factor, so other frames "
            "would be held out than asked for. Choose one without."
        )


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
