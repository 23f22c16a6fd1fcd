"""ldo replay"""

from collections import Counter
from contextlib import ExitStack, closing
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.recordings.replay import RecordedActor, open_recording
from ldo_service.runtime.replay import Replayed

from .options import Recording
from .progress import progress


def replay(
    recording: Recording,
    verify: Annotated[
        bool, tyro.conf.arg(help="end with exit code 5 at the first difference")
    ] = False,
    actor: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="NAME", help="this actor alone; may be repeated; default: all"),
    ] = (),
) -> None:
    """Feed fresh actors what they took in a recording, and compare what they make of it.

    Restarts, failures and the room that each step saw are part of it. Nothing is sent. Without
    --verify a difference is printed and is no error.

      ldo replay recordings/desk --verify
    """
    console = Console(stderr=True, highlight=False)
    with ExitStack() as stack:
        actors = [stack.enter_context(closing(a)) for a in open_recording(recording, tuple(actor))]
        for caveat in dict.fromkeys(line for recorded in actors for line in recorded.caveats()):
            console.print(f"note: {caveat}", soft_wrap=True)
        replayed = [_replay(recorded, verify, console) for recorded in actors]
    Console().print(_table(replayed))


def _replay(recorded: RecordedActor, verify: bool, console: Console) -> Replayed:
    done = 0
    with progress(recorded.name, recorded.steps, console) as advance:

        def step() -> None:
            nonlocal done
            done += 1
            advance(done)

        replayed = recorded.replay(step)
    for note in replayed.notes:
        console.print(f"note: {note}", soft_wrap=True)
    if verify:
        replayed.verify()
    elif replayed.difference:
        console.print(f"{replayed.difference}", soft_wrap=True)
    return replayed


def _table(rows: list[Replayed]) -> Table:
    table = Table("actor", "steps", "starts", "failed", "took", "made", "same")
    for row in rows:
        failed = f"{row.failures} ({row.set_aside} set aside)" if row.failures else "0"
        starts = f"{row.starts} ({row.restored} from a state)" if row.restored else str(row.starts)
        same = "yes" if row.difference is None else f"no: {row.difference.step}"
        counts = (_counts(row.taken), _counts(row.made))
        table.add_row(row.actor, str(row.steps), starts, failed, *counts, same)
    return table


def _counts(messages: Counter[str]) -> str:
    return "\n".join(f"{count} {topic}" for topic, count in messages.items())
