"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ldo_service.runs.job import Advance

LINES = 10  # in a log file


@contextmanager
def progress(title: str, total: int, console: Console) -> Iterator[Advance]:
    """A function to call with the number of items done, and with that of all where it grew."""
    if not console.is_terminal:
        yield _plain(title, total, console)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done, total=None: bar.update(task, completed=done, total=total)


def _plain(title: str, total: int, console: Console) -> Advance:
    said = 0

    def advance(done: int, grown: int | None = None, /) -> None:
        nonlocal said, total
        if grown not in (None, total):
            said, total = 0, grown
        if done * LINES // total > said:
            said = done * LINES // total
            console.print(f"{title}: {done} of {total}", highlight=False)

    return advance
