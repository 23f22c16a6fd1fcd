"""Command `ldo replay`: replay a recording, and compare new outputs with the recorded outputs."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.recordings.replay import ReplayReport
from ldo_service.runs.replayed import RecordedActor, open_recording

from .options import Recording, argument, note_console, progress


def replay(
    recording: Recording,
    verify: Annotated[bool, argument(help="exit with code 5 at the first difference")] = False,
    actor: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="NAME", help="replay only this actor; may be repeated; default: all"),
    ] = (),
) -> None:
    """Replay a recording with newly started actors, and compare their outputs with the recording.

    The replay also repeats the recorded restarts and failures. If an actor could not send a message
    in the recording because its consumers were busy, it cannot send it in the replay either. The
    replay publishes nothing. Without --verify, the exit code is 0 even if the command prints
    differences.

      ldo replay recordings/desk --verify
    """
    console = note_console()
    actors = open_recording(recording, tuple(actor))
    for caveat in dict.fromkeys(line for recorded in actors for line in recorded.caveats()):
        console.print(f"note: {caveat}")
    with progress("replay", sum(recorded.steps for recorded in actors), console) as advance:
        step = map(advance, itertools.count(1))
        replayed = [_replay(recorded, verify, console, lambda: next(step)) for recorded in actors]
    Console().print(_table(replayed))


def _replay(
    recorded: RecordedActor, verify: bool, console: Console, advance: Callable[[], None]
) -> ReplayReport:
    replayed = recorded.replay(advance)
    for note in replayed.notes:
        console.print(f"note: {note}")
    if verify:
        replayed.verify()
    elif replayed.difference:
        console.print(f"{replayed.difference}")
    return replayed


def _table(rows: list[ReplayReport]) -> Table:
    table = Table("actor", "steps", "inputs", "outputs", "same")
    for row in rows:
        same = "yes" if row.difference is None else f"until\n{row.difference.step}"
        took, made = _counts(row.taken), _counts(row.made)
        table.add_row("\n".join(_first_column(row)), str(row.steps), took, made, same)
    return table


def _first_column(row: ReplayReport) -> Iterator[str]:
    """Yield the name of the actor, then its restarts and failures."""
    yield row.actor
    if row.starts != 1:
        yield f"{row.starts} starts"
    if row.restored:
        yield f"{row.restored} restored"
    if row.failures:
        yield f"{row.failures} failed"
    if row.dead_lettered:
        yield f"{row.dead_lettered} dead letters"


def _counts(messages: Counter[str]) -> str:
    return "\n".join(f"{count} {topic}" for topic, count in messages.items())
