"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LINES = 10  # in a log file


@contextmanager
def progress(title: str, total: int, console: Console) -> Iterator[Callable[[int], None]]:
    """A function to call with the number of items done."""
    if not console.is_terminal:
        yield _plain(title, total, console)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)


def _plain(title: str, total: int, console: Console) -> Callable[[int], None]:
    said = 0

    def advance(done: int) -> None:
        nonlocal said
        if done * LINES // total > said:
            said = done * LINES // total
            console.print(f"{title}: {done} of {total}", highlight=False)

    return advance
