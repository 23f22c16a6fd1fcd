"""Command `ldo run`: track and map a sequence offline, and write the results to a folder."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table

from ldo_service.config import Config, checked, load_config
from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.geometry.sequence import Sequence
from ldo_service.runs.folder import RunWriter, prepare
from ldo_service.runs.front_end import FrontEnd
from ldo_service.runs.job import Advance, RunOptions, require_held_out
from ldo_service.runs.networks import require_usable_networks
from ldo_service.runs.offline import run_offline
from ldo_service.runs.realtime import run_realtime
from ldo_service.runs.source import Selection, recorded_prior

from .options import (
    ConfigFile,
    Device,
    HoldOutEvery,
    Localize,
    MaxFrames,
    Overwrite,
    Preset,
    RecordedOdometry,
    Settings,
    Source,
    Stride,
    Topics,
    argument,
    localizing,
    note_console,
    progress,
    with_device,
    with_preset,
    with_topics,
)

# Options of `ldo run` that exclude each other.
EXCLUSIVE = {
    "--realtime": ("--refine-iterations", "--reuse-front-end", "--keep-front-end"),
    "--reuse-front-end": (
        *("--odometry-prior", "--recorded-odometry", "--localize", "--keep-front-end"),
    ),
    "--recorded-odometry": ("--odometry-prior",),
    "--localize": ("--keep-front-end",),
}


Out = Annotated[Path, argument(metavar="DIR", help="folder for the results")]
Threads = Annotated[
    int | None,
    argument(
        metavar="T",
        help="threads of the renderer; 0: all cores, or with --realtime all but one, which the "
        "tracker uses",
    ),
]
RefineIterations = Annotated[
    int,
    argument(
        metavar="N",
        help="optimize the map for N more iterations at the end, saved in DIR/refined",
    ),
]
OdometryPrior = Annotated[
    Path | None,
    argument(
        metavar="FILE",
        help="poses of the robot's base from another odometry, in the TUM format, as initial "
        "guess for the tracker; tracker.T_base_camera must be the camera pose relative to the "
        "base",
    ),
]
KeepFrontEnd = Annotated[
    bool,
    argument(help="record the outputs of tracker and detector, with images, in DIR/front_end.mcap"),
]
ReuseFrontEnd = Annotated[
    Path | None,
    argument(
        metavar="RUN",
        help="use the recorded outputs of tracker and detector of an earlier RUN over the same "
        "frames, to compare settings of the other actors on equal poses",
    ),
]
Realtime = Annotated[
    bool, argument(help="send frames at the times of their stamps, and drop late ones")
]


def run(
    source: Source,
    out: Out,
    preset: Preset = "",
    config: ConfigFile = None,
    set: Settings = (),
    topic: Topics = (),
    recorded_odometry: RecordedOdometry = False,
    max_frames: MaxFrames = None,
    stride: Stride = 1,
    hold_out_every: HoldOutEvery = None,
    threads: Threads = None,
    refine_iterations: RefineIterations = 0,
    localize: Localize = None,
    odometry_prior: OdometryPrior = None,
    keep_front_end: KeepFrontEnd = False,
    reuse_front_end: ReuseFrontEnd = None,
    device: Device = None,
    realtime: Realtime = False,
    overwrite: Overwrite = False,
) -> None:
    """Track and map a sequence; write trajectory, map and metrics to a folder.

    Unless --realtime is given, the result depends only on the frames and the configuration, not on
    the load of the machine. No ground truth is needed; `ldo eval DIR SOURCE` compares the result
    with the ground truth of SOURCE.

      ldo run synthetic:room --out runs/room
      ldo run ~/data/rgbd_dataset_freiburg1_desk --out runs/desk --max-frames 300
      ldo run ~/data/desk_again --out runs/again --localize runs/desk
      ldo run synthetic:flat --out runs/literal --preset paper
      ldo run synthetic:flat --out runs/half --reuse-front-end runs/flat --set mapper.iterations=7
    """
    require_compatible(
        {
            "--realtime": realtime,
            "--refine-iterations": refine_iterations,
            "--reuse-front-end": reuse_front_end,
            "--keep-front-end": keep_front_end,
            "--odometry-prior": odometry_prior,
            "--recorded-odometry": recorded_odometry,
            "--localize": localize,
        }
    )
    require_separate(localize, out, refine_iterations)
    console = note_console()
    loaded = load_config(config, with_topics(with_preset(set, preset), topic))
    settings = localizing(with_options(loaded, hold_out_every, threads), localize)
    settings = with_device(settings, device)
    require_usable_networks(settings)
    selection = Selection(stride, max_frames)
    require_held_out(stride, settings.tracker.hold_out)
    sequence = open_sequence(source, settings.dataset.options())
    prior = Trajectory.load(odometry_prior) if odometry_prior else None
    if recorded_odometry:
        prior = recorded_prior(sequence, selection.indices(sequence), settings, console.print)
    job = RunOptions(
        *(sequence, out, settings, selection, console.print),
        refine=refine_iterations,
        prior=prior,
        front_end=kept_front_end(reuse_front_end, out, settings, sequence, selection),
        keep_front_end=keep_front_end,
    )
    prepare(out, overwrite)
    record = execute(job, run_realtime if realtime else run_offline, console)
    print_results(record, out, localize)


def print_results(record: RunWriter, out: Path, localize: Path | None) -> None:
    """Print the summary of a finished run, with notes on unmerged submaps and on localization."""
    console = Console(markup=False)
    console.print(summary_table(record.summary, out))
    if record.summary["gaussians_unmerged"]:
        console.print(format_unmerged(record.summary["gaussians_unmerged"]), style="dim")
    if localize:
        console.print(format_localization(record.statuses, localize), style="dim")


def execute(
    job: RunOptions,
    go: Callable[[RunOptions, Advance], RunWriter],
    console: Console,
    title: str = "run",
) -> RunWriter:
    """Run a job with a progress bar.

    Args:
        job: Sequence, folder and options of the run.
        go: Function that runs the job: `run_offline` or `run_realtime`.
        console: Console of the progress bar.
        title: Title of the progress bar.

    Raises:
        ConfigError: The folder of the run cannot be written.
    """
    with progress(title, job.work, console) as advance:
        try:
            return go(job, advance)
        except OSError as error:
            raise ConfigError(
                f"{job.folder} cannot be written: {error.strerror}. The files in this "
                "folder are incomplete. Free some space, or choose another folder."
            ) from error


def kept_front_end(
    run: Path | None, out: Path, settings: Config, sequence: Sequence, selection: Selection
) -> FrontEnd | None:
    """Open the recorded outputs of tracker and detector; return None without --reuse-front-end.

    Args:
        run: Folder of the earlier run, the value of --reuse-front-end; None without this option.
        out: Folder of the new run.
        settings: Configuration of the new run.
        sequence: Frames of the new run.
        selection: Stride and maximum number of frames of the new run.

    Raises:
        ConfigError: The run would replace the recording that it reads.
    """
    if run is None:
        return None
    if run.expanduser().resolve() == out.expanduser().resolve():
        raise ConfigError(
            f"--out {out} is also the folder of --reuse-front-end, and the run would replace the "
            "recording that it reads. Choose another --out."
        )
    return FrontEnd.open(run, settings, sequence, selection)


def format_unmerged(gaussians: int) -> str:
    """Return a note on the Gaussians of submaps that were never merged with the map."""
    return (
        f"map.ply lacks {gaussians:,} Gaussians: tracking was lost, and the submaps after the loss "
        "were never merged with the map. Their poses in the map are unknown."
    )


def format_localization(statuses: dict[str, int], folder: Path) -> str:
    """Return a note on the result of localization in a finished map.

    Args:
        statuses: Number of frames, by tracking status.
        folder: Run folder with the map.
    """
    if statuses["OK"] + statuses["WEAK"] == 0:
        return (
            f"No frame was localized. Check that {folder} is a map of this place, made from "
            "similar heights and with a camera of a similar field of view."
        )
    return f"The run localized in the map of {folder}, which is unchanged."


def with_options(config: Config, hold_out: int | None, threads: int | None) -> Config:
    """Return the configuration with the values of --hold-out-every and --threads.

    An option that is None keeps the configured value.
    """
    tracker, mapper = config.tracker, config.mapper
    if hold_out is not None:
        tracker = replace(tracker, hold_out=hold_out)
    if threads is not None:
        mapper = replace(mapper, threads=threads)
    return checked(replace(config, tracker=tracker, mapper=mapper))


def require_compatible(options: Mapping[str, object]) -> None:
    """Check that no two of the given options exclude each other; see EXCLUSIVE.

    Args:
        options: Values of the options by name; a true value means that the option is given.

    Raises:
        ConfigError: Two such options are given.
    """
    for option, others in EXCLUSIVE.items():
        wrong = [other for other in others if options[other]]
        if options[option] and wrong:
            raise ConfigError(f"{option} and {wrong[0]} exclude each other. Remove one of them.")


def require_separate(localize: Path | None, out: Path, refine: int) -> None:
    """Check that localization does not change the map that it uses.

    Raises:
        ConfigError: The run would refine or replace that map.
    """
    if localize and refine:
        raise ConfigError(
            "--refine-iterations would change the map of --localize. Remove --refine-iterations."
        )
    if localize and localize.expanduser().resolve() == out.expanduser().resolve():
        raise ConfigError(f"--out {out} would replace the map of --localize. Choose another --out.")


def summary_table(summary: dict[str, Any], out: Path) -> Table:
    """Return a table with the summary of a finished run."""
    table = Table(title=f"{out}", show_header=False)
    status = summary["status"]
    rows = {
        "frames": f"{summary['frames']} ({summary['frames_rejected']} rejected)",
        "tracking": ", ".join(f"{count} {name}" for name, count in status.items()),
        "keyframes": summary["keyframes"],
        "Gaussians": f"{summary['gaussians']:,}",
        **({"objects": summary["objects"]} if summary["objects"] else {}),
        "speed": f"{summary['fps']:.1f} FPS ({summary['wall_s']:.1f} s, input included)",
        "median step": ", ".join(
            f"{name} {summary['stage_ms'][name]['p50']:.1f} ms"
            for name in ("tracker", "mapper")
            if name in summary["stage_ms"]
        ),
        "peak memory": f"{summary['peak_rss_mb']:.0f} MB",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    return table
