"""ldo suite"""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from ldo_service.errors import ConfigError, DataError
from ldo_service.suites import SuiteRun, SuiteRunner, load_suite, markdown

from .options import Overwrite, Settings

TABLE = "table.md"


def suite(
    name: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="SUITE", help="a file, or the name of one that comes with it"),
    ],
    out: Annotated[Path, tyro.conf.arg(metavar="DIR", help="folder for the runs and the table")],
    data: Annotated[
        Path, tyro.conf.arg(metavar="DIR", help="where the suite's folders of data lie")
    ] = Path(),
    set: Settings = (),
    overwrite: Overwrite = False,
) -> None:
    """Run and judge a list of sequences and variants; one table with means and spread.

    Prints the table in Markdown and writes it to DIR/table.md. Runs that are finished are not made
    again: an interrupted suite goes on where it stopped. Sequences whose data is not there are
    left out, and the table says so. Those that come with it are the tables of the paper, its
    sensitivity and its ablation. `--set` is for all runs; variants say what differs.

      ldo suite table-1 --data ~/data --out suites/table-1
      ldo suite table-9 --data ~/data --out suites/ablation --set detector.model=nano
      ldo suite my-suite.yaml --data ~/data --out suites/mine
    """
    chosen = load_suite(name)
    work = SuiteRunner(chosen, data.expanduser(), out.expanduser(), set, overwrite)
    _require_folder(work.out)
    console, total = Console(stderr=True), len(work.entries())
    done: list[SuiteRun] = []

    def begun(entry: SuiteRun) -> None:
        done.append(entry)
        console.print(f"{len(done)} of {total}: {entry.folder}", highlight=False)

    outcomes = list(work.outcomes(begun))
    if all(outcome.missing == "no data" for outcome in outcomes):
        raise DataError(
            f"{work.data} has none of the sequences of {name}: --data says where they are."
        )
    table = markdown(chosen, outcomes)
    try:
        (work.out / TABLE).write_text(table)
    except OSError as error:
        raise ConfigError(f"{work.out / TABLE} cannot be written: {error.strerror}.") from error
    print(table, end="")
    if any(outcome.missing == "failed" for outcome in outcomes):
        sys.exit(1)


def _require_folder(folder: Path) -> None:
    """Before hours of runs. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror}.") from error
