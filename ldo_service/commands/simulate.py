"""Command `ldo simulate`: run all actors on a logical clock, and print digests of their outputs."""

import json
from dataclasses import asdict
from typing import Annotated

from rich.console import Console
from rich.table import Table

from ldo_service.config import load_config
from ldo_service.datasets import open_sequence
from ldo_service.runs.networks import require_usable_networks
from ldo_service.runs.simulation import ActorDigest, simulate_graph
from ldo_service.runs.source import Selection, recorded_prior

from .options import (
    ConfigFile,
    Json,
    MaxFrames,
    Preset,
    RecordedOdometry,
    Settings,
    Source,
    Stride,
    Topics,
    argument,
    note_console,
    progress,
    with_preset,
    with_topics,
)
from .run import with_options


def simulate(
    source: Source,
    preset: Preset = "",
    config: ConfigFile = None,
    set: Settings = (),
    topic: Topics = (),
    recorded_odometry: RecordedOdometry = False,
    max_frames: MaxFrames = None,
    stride: Stride = 1,
    threads: Annotated[
        int | None, argument(metavar="T", help="threads of the renderer; 0: one per core")
    ] = None,
    json_: Annotated[Json, argument(name="json")] = False,
) -> None:
    """Run all actors on a logical clock, and print a digest of each actor's outputs.

    The digests depend only on the frames, the configuration and the instruction set of the CPU.
    They do not depend on the number of threads or the load of the machine. The command writes no
    files.

      ldo simulate synthetic:room --max-frames 60 --json
    """
    console = note_console()
    settings = with_options(
        load_config(config, with_topics(with_preset(set, preset), topic)),
        hold_out=None,
        threads=threads,
    )
    require_usable_networks(settings)
    sequence = open_sequence(source, settings.dataset.options())
    selection = Selection(stride, max_frames)
    prior = None
    if recorded_odometry:
        indices = selection.indices(sequence)
        prior = recorded_prior(sequence, indices, settings, console.print)
    with progress("simulate", len(selection.indices(sequence)), console) as advance:
        made = simulate_graph(sequence, settings, selection, console.print, advance, prior)
    if json_:
        print(json.dumps({actor: asdict(digest) for actor, digest in made.items()}))
    else:
        Console().print(_table(made))


def _table(made: dict[str, ActorDigest]) -> Table:
    table = Table("actor", "messages", "digest")
    for actor, digest in made.items():
        table.add_row(actor, str(digest.messages), digest.digest)
    return table
