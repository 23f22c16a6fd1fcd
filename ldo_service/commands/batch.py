"""Command `ldo batch`: run, evaluate and export many recordings."""

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ldo_service.batch import Executor, LocalExecutor, RayExecutor, RayNeeds, find_recordings
from ldo_service.batch.batch import Batch, default_workers
from ldo_service.batch.job import BatchJob, Outcome, RunPlan
from ldo_service.batch.report import COLUMNS, JSON_FILE, PAGE_FILE, cells, report_of, save_report
from ldo_service.batch.sources import listed
from ldo_service.batch.store import Store, open_store
from ldo_service.config import load_config
from ldo_service.errors import ConfigError, LdoError
from ldo_service.runs.export import ExportFormat
from ldo_service.runs.networks import require_usable_networks

from .options import (
    ConfigFile,
    Device,
    HoldOutEvery,
    MaxFrames,
    Preset,
    Settings,
    Stride,
    argument,
    note_console,
    with_device,
    with_preset,
)
from .run import with_options

# Memory for each recording. The peak was 0.4 to 1.4 GB over the recordings of docs/batch.md.
MEMORY_GB = 2.0
STAGED_GB = 20.0
WIDTH = 170  # Columns of the table when the output is no terminal.


Sources = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    argument(
        metavar="SOURCES",
        help="recordings, as for `ldo run`; folders or buckets of recordings; patterns such as "
        "'s3://bucket/night/*'",
    ),
]
Out = Annotated[
    str, argument(metavar="WHERE", help="folder or bucket for the results: DIR, s3://..., ...")
]
SourcesFrom = Annotated[
    Path | None, argument(metavar="FILE", help="text file with more SOURCES, one per line")
]
RefineIterations = Annotated[
    int, argument(metavar="N", help="optimize each map for N more iterations at the end")
]
Exports = Annotated[
    tyro.conf.UseAppendAction[tuple[ExportFormat, ...]],
    argument(metavar="FORMAT", help="also write a format of `ldo export`; may be repeated"),
]
Workers = Annotated[
    int | None,
    argument(
        metavar="N",
        help="recordings at the same time; default: as many as the cores and the memory of "
        "this machine, or the hosts of the cluster, allow",
    ),
]
Threads = Annotated[
    int,
    argument(
        metavar="T",
        help="threads for each recording, and with --cluster the CPUs reserved for it",
    ),
]
MemoryGb = Annotated[
    float, argument(metavar="GB", help="memory that is reserved for each recording")
]
Cluster = Annotated[
    str | None,
    argument(
        metavar="ADDRESS", help="run on this Ray cluster: HOST:PORT, or auto for the local one"
    ),
]
Gpus = Annotated[float, argument(metavar="N", help="GPUs of the cluster for each recording")]
Staging = Annotated[
    Path | None,
    argument(
        metavar="DIR",
        help="folder on each machine for unfinished results and copies of recordings; default: "
        "WHERE/.staging, but with a bucket or --cluster the temporary folder of the system",
    ),
]
MaxStagedGb = Annotated[
    float,
    argument(metavar="GB", help="maximum total size of the copies of recordings, for each machine"),
]


def batch(
    sources: Sources = (),
    *,
    out: Out,
    sources_from: SourcesFrom = None,
    preset: Preset = "",
    config: ConfigFile = None,
    set: Settings = (),
    max_frames: MaxFrames = None,
    stride: Stride = 1,
    hold_out_every: HoldOutEvery = None,
    refine_iterations: RefineIterations = 0,
    export: Exports = (),
    workers: Workers = None,
    threads: Threads = 1,
    device: Device = None,
    memory_gb: MemoryGb = MEMORY_GB,
    cluster: Cluster = None,
    gpus: Gpus = 0.0,
    staging: Staging = None,
    max_staged_gb: MaxStagedGb = STAGED_GB,
) -> None:
    """Run, evaluate and export many recordings, on this machine or on a Ray cluster.

    Each recording has its own process and its own folder WHERE/NAME-KEY. KEY is a digest of the
    content of the recording, the configuration and the version of LDO-SLAM. If you repeat the
    command, finished recordings are skipped, and failed or interrupted recordings are processed
    again. A failed recording does not stop the others. WHERE/batch.json and WHERE/index.html list
    all recordings of the last call.

      ldo batch ~/night/* --out runs/night
      ldo batch s3://robots/night s3://robots/day/*.mcap --out s3://results/night --export splat
      ldo batch --sources-from list.txt --out /shared/results --cluster auto --workers 20
    """
    console = note_console()
    settings = with_preset(set, preset)
    plan = _plan(
        *(config, settings, hold_out_every, stride, max_frames, refine_iterations, export),
        *(threads, device),
    )
    _require_positive(
        workers=workers, threads=threads, memory_gb=memory_gb, max_staged_gb=max_staged_gb
    )
    where = open_store(out)
    executor = _executor(cluster, RayNeeds(threads, memory_gb, gpus), workers, device)
    found = _found(sources, sources_from, console)
    work = Batch(
        plan, where, staging or _default_staging(where, cluster), round(max_staged_gb * 1e9)
    )
    report = _execute(work, found, executor, console)
    _print_table(report, where)
    if any(outcome.status == "failed" for outcome in report):
        sys.exit(1)


def _plan(
    config: Path | None,
    settings: tuple[str, ...],
    hold_out_every: int | None,
    stride: int,
    max_frames: int | None,
    refine: int,
    exports: tuple[ExportFormat, ...],
    threads: int,
    device: str | None,
) -> RunPlan:
    """Check that the networks can be used, and return the plan of the work on each recording."""
    loaded = with_options(load_config(config, settings), hold_out_every, threads)
    loaded = with_device(loaded, device)
    require_usable_networks(loaded)
    return RunPlan(
        config=loaded,
        stride=stride,
        max_frames=max_frames,
        refine=refine,
        exports=tuple(dict.fromkeys(exports)),
        threads=threads,
    )


def _found(
    sources: Sequence[str], sources_from: Path | None, console: Console
) -> dict[str, LdoError | None]:
    """Find the recordings, and print notes about sources that contain none.

    Raises:
        ConfigError: No sources are given.
    """
    words = [*sources, *(listed(sources_from) if sources_from else ())]
    if not words:
        raise ConfigError("no SOURCES are given. Name recordings, or use --sources-from FILE.")
    return find_recordings(words, lambda note: console.print(f"batch: {note}"))


def _executor(
    cluster: str | None, needs: RayNeeds, workers: int | None, device: str | None
) -> Executor:
    """Return the executor on a cluster, or on this machine if `cluster` is None."""
    if cluster is not None:
        if device == "cuda" and not needs.gpus:
            raise ConfigError(
                "--device cuda with --cluster needs --gpus, such as --gpus 0.5, because Ray hides "
                "the GPUs from a task that reserves none."
            )
        return RayExecutor(cluster, needs, workers)
    if needs.gpus:
        raise ConfigError(
            f"--gpus {needs.gpus:g} applies only with --cluster. Remove --gpus, or add --cluster."
        )
    return LocalExecutor(workers or default_workers(needs.cpus, needs.memory_gb))


def _require_positive(**options: float | None) -> None:
    for name, value in options.items():
        if value is not None and value <= 0:
            raise ConfigError(f"--{name.replace('_', '-')} {value:g} must be positive.")


def _default_staging(out: Store, cluster: str | None) -> Path:
    if out.is_local and cluster is None:
        return out.local / ".staging"  # Finished results are then moved, not copied.
    return Path(tempfile.gettempdir()) / "ldo-batch"


def _execute(
    work: Batch, found: Mapping[str, LdoError | None], executor: Executor, console: Console
) -> list[Outcome]:
    """Run the batch, print a line of progress for each recording, and write the report."""
    progress = _Progress(console, len(found))
    outcomes = {source: _without_results(source, error) for source, error in found.items()}
    sources = [source for source, error in found.items() if error is None]
    started_s = time.perf_counter()

    def save(is_interrupted: bool) -> None:
        wall_s = time.perf_counter() - started_s
        report = report_of(list(outcomes.values()), wall_s, is_interrupted=is_interrupted)
        save_report(work.out, report)

    save(is_interrupted=True)  # A folder that cannot be written is found before hours of runs.
    console.print(f"batch: looking for results of {_counted(len(found))}")
    is_interrupted = True
    try:
        for outcome in outcomes.values():
            if outcome.status == "failed":
                progress.add(outcome)
        for outcome in work.outcomes(sources, executor, progress.begin):
            outcomes[outcome.source] = outcome
            progress.add(outcome)
        is_interrupted = False
    finally:
        save(is_interrupted)
    return list(outcomes.values())


def _without_results(source: str, error: LdoError | None) -> Outcome:
    status = "missing" if error is None else "failed"
    text = "" if error is None else str(error)
    return Outcome(source=source, name=Path(source).name, folder="", status=status, error=text)


class _Progress:
    """Progress of a batch: a line for each recording, with an estimate of the remaining time.

    The estimate assumes that the time of a recording is proportional to its size, or that all take
    the same time if a size is unknown.
    """

    def __init__(self, console: Console, total: int) -> None:
        self._console, self._total, self._done = console, total, 0
        self._weights: dict[str, float] = {}
        self._all = self._finished = 0.0
        self._started_s = time.perf_counter()

    def begin(self, jobs: list[BatchJob]) -> None:
        """Start the estimate of the remaining time for the recordings that will run."""
        sizes = {job.recording.source: float(job.recording.size_bytes) for job in jobs}
        is_known = all(sizes.values())
        self._weights = {source: size if is_known else 1.0 for source, size in sizes.items()}
        self._all, self._started_s = sum(self._weights.values()), time.perf_counter()
        self._console.print(f"batch: {len(jobs)} of {_counted(self._total)} to run")

    def add(self, outcome: Outcome) -> None:
        """Print the outcome of a recording."""
        self._done += 1
        self._finished += self._weights.get(outcome.source, 0.0)
        spent = f" in {outcome.costs.wall_s:.0f} s" if outcome.costs else ""
        what = {"done": f"done{spent}", "kept": "kept from an earlier call"}
        text = what.get(outcome.status, f"{outcome.status}: {outcome.error}")
        line = f"{self._done} of {self._total}: {outcome.name} {text}{self._left()}"
        self._console.print(line)

    def _left(self) -> str:
        if not 0 < self._finished < self._all:
            return ""
        elapsed_s = time.perf_counter() - self._started_s
        left_s = elapsed_s * (self._all - self._finished) / self._finished
        text = f"{left_s / 60:.0f} min" if left_s >= 90 else f"{left_s:.0f} s"
        return f"; about {text} left"


def _counted(recordings: int) -> str:
    return f"{recordings} recording{'s' if recordings != 1 else ''}"


def _print_table(outcomes: Sequence[Outcome], out: Store) -> None:
    console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
    table = Table()
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in COLUMNS[:2] else "right")
    for outcome in outcomes:
        table.add_row(*map(escape, cells(outcome)))
    console.print(table)
    for name in (JSON_FILE, PAGE_FILE):
        console.print(out.at(name).url, markup=False, soft_wrap=True)
