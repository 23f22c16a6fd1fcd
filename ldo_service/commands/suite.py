"""Command `ldo suite`: run and evaluate several sequences and variants, and print tables."""

import sys
from pathlib import Path
from typing import Annotated

import tyro

from ldo_service.errors import ConfigError, DataError
from ldo_service.evaluation.lpips import Lpips
from ldo_service.suites import SuiteRun, SuiteRunner, load_suite, markdown

from .options import Overwrite, Settings, argument, note_console

TABLE = "table.md"


SuiteName = Annotated[
    str,
    tyro.conf.Positional,
    argument(metavar="SUITE", help="YAML file, or the name of a built-in suite"),
]
Out = Annotated[Path, argument(metavar="DIR", help="folder for the runs and the tables")]
Data = Annotated[Path, argument(metavar="DIR", help="folder with the data sets of the suite")]
Workers = Annotated[
    int,
    argument(
        metavar="N",
        help="runs at the same time; with more than one, the times of the tables depend on the "
        "load",
    ),
]
LpipsFile = Annotated[
    Path | None,
    argument(
        metavar="FILE.onnx",
        help="network of LPIPS, as for `ldo eval`; without it, the tables have no LPIPS",
    ),
]


def suite(
    name: SuiteName,
    out: Out,
    data: Data = Path(),
    set: Settings = (),
    workers: Workers = 1,
    lpips: LpipsFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Run and evaluate several sequences and variants, and print tables of their metrics.

    The command prints the tables in Markdown and writes them to DIR/table.md. Each result is
    the mean over the seeds, followed by the standard deviation if there are several seeds. If you
    repeat an interrupted command, finished runs are not repeated. A sequence without data is
    skipped and marked in the tables. The built-in suites give the tables of the LDO-SLAM paper, its
    sensitivity analysis and its ablation. `--set` changes a setting in all runs; the suite defines
    the settings of each variant.

      ldo suite table-1 --data ~/data --out suites/table-1
      ldo suite table-9 --data ~/data --out suites/ablation --set detector.model=nano
      ldo suite my-suite.yaml --data ~/data --out suites/mine
    """
    if workers < 1:
        raise ConfigError(f"--workers {workers} must be at least 1.")
    chosen = load_suite(name)
    if lpips is not None:
        Lpips(lpips)  # A wrong file is refused before the first run.
    folders = data.expanduser(), out.expanduser()
    work = SuiteRunner(chosen, *folders, set, overwrite, workers, lpips)
    _require_folder(work.out)
    console, total = note_console(), len(work.entries())
    done: list[SuiteRun] = []

    def begun(entry: SuiteRun) -> None:
        done.append(entry)
        console.print(f"{len(done)} of {total}: {entry.folder}")

    outcomes = list(work.outcomes(begun))
    if all(outcome.missing == "no data" for outcome in outcomes):
        raise DataError(
            f"{work.data} has none of the sequences of {name}. Give their folder with --data."
        )
    table = markdown(chosen, outcomes, has_lpips=lpips is not None)
    _save(work.out / TABLE, table)
    print(table, end="")
    if any(outcome.missing == "failed" for outcome in outcomes):
        sys.exit(1)


def _require_folder(folder: Path) -> None:
    """Create the folder, so that a wrong path is found before hours of runs.

    Raises:
        ConfigError: The folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be written: {error.strerror}. Choose another --out."
        ) from error


def _save(path: Path, table: str) -> None:
    """Write the tables to a file.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        path.write_text(table)
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be written: {error.strerror}. Free some disk space or make "
            f"{path.parent} writable, and repeat the command: finished runs are kept."
        ) from error
