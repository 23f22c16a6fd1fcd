"""Options that several commands share, and the progress of long work."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ldo_service.actors.detector import require_detector
from ldo_service.actors.vlm_labeller import require_labeller
from ldo_service.config import Config, actor_parameters
from ldo_service.runs.job import Advance
from ldo_service.tracking.keyframe_database import load_keyframe_database

LINES = 10  # in a log file


ConfigFile = Annotated[
    Path | None,
    tyro.conf.arg(name="config", metavar="FILE", help="YAML with the settings that differ"),
]
Settings = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        name="set",
        metavar="SECTION.FIELD=VALUE",
        help="change one setting; may be repeated. `ldo config` lists them",
    ),
]
Source = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="SOURCE",
        help="folder of a data set (TUM RGB-D, Replica/NICE-SLAM, ScanNet export or 7-Scenes, "
        "recognised by its files), a recording, or synthetic:room, :tour or :flat",
    ),
]
MaxFrames = Annotated[int | None, tyro.conf.arg(metavar="N", help="stop after so many frames")]
Stride = Annotated[int, tyro.conf.arg(metavar="N", help="take every n-th frame")]
Recording = Annotated[
    Path,
    tyro.conf.Positional,
    tyro.conf.arg(metavar="DIR", help="folder that `ldo record` wrote"),
]
ActorNames = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="ACTOR",
        help="run this actor alone, as a part of a service that runs already; may be repeated",
    ),
]
StateFolder = Annotated[
    Path | None,
    tyro.conf.arg(
        name="state",
        aliases=["--resume"],
        metavar="DIR",
        help="where actors keep what a successor needs, and go on from what they find; default: a "
        "temporary folder",
    ),
]
Localize = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="DIR",
        help="track in the map that `ldo run` left in this folder, and do not change it",
    ),
]
Robot = Annotated[
    str, tyro.conf.arg(metavar="NAME", help="second part of every topic: ldo/NAME/...")
]
EndpointAddress = Annotated[
    str, tyro.conf.arg(metavar="ADDRESS", help="where the service's router listens")
]
KeysFolder = Annotated[
    Path | None,
    tyro.conf.arg(
        name="keys",
        metavar="DIR",
        help="keys for TLS, a folder that `ldo keys add` made; ADDRESS is then tls/HOST:PORT",
    ),
]
Overwrite = Annotated[bool, tyro.conf.arg(help="replace an earlier run in the folder")]
Json = Annotated[bool, tyro.conf.arg(help="print one JSON document and nothing else")]


def localizing(config: Config, folder: Path | None) -> Config:
    """The configuration with --localize. Raises DataError for a folder without a map."""
    if folder is None:
        return config
    folder = folder.expanduser().resolve()
    load_keyframe_database(folder)
    tracker = replace(config.tracker, localization_map=str(folder))
    return replace(config, tracker=tracker)


def with_usable_networks(config: Config) -> Config:
    """The same. Raises ConfigError when a network that it names cannot be used, which a service
    only warns about."""
    parameters = actor_parameters(config)
    require_detector(parameters.detector)
    require_labeller(parameters.vlm_labeller)
    return config


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
