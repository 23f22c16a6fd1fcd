"""Options that several commands share, and progress bars."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ldo_service.config import Config, checked, known_presets
from ldo_service.errors import ConfigError
from ldo_service.runs.job import Advance
from ldo_service.synthetic import SCENES
from ldo_service.tracking.localizer import load_keyframe_database

NO_DEFAULTS = ("None", "False", "", "''")  # Default values that the help does not print.
MAX_SIDE_PX = 8192  # Maximum width and height of --size.
LINES = 10  # Lines of progress per command if the output is no terminal.


def argument(**properties: Any) -> Any:
    """Describe an argument as `tyro.conf.arg` does, but omit defaults in NO_DEFAULTS from help."""
    return tyro.conf.arg(help_behavior_hint=_default_hint, **properties)


def _default_hint(default: str) -> str:
    return "" if default in NO_DEFAULTS else f"(default: {default})"


ConfigFile = Annotated[
    Path | None,
    argument(name="config", metavar="FILE", help="YAML file with the settings to change"),
]
Settings = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        name="set",
        metavar="SECTION.FIELD=VALUE",
        help="change one setting; may be repeated. `ldo config` lists the settings",
    ),
]
Preset = Annotated[
    str,
    argument(
        metavar="NAME",
        help="replace default settings by those of the preset NAME, before --config and --set; "
        + "; ".join(f"{name}: {about}" for name, about in known_presets().items()),
    ),
]
Device = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    argument(
        metavar="auto|cpu|cuda",
        help="device of mapper, tracker and networks, instead of service.device; auto uses a GPU "
        "for mapper and tracker where `ldo bench --device cuda` measured it to be faster, and for "
        "networks if onnxruntime supports one (experimental)",
    ),
]
Source = Annotated[
    str,
    tyro.conf.Positional,
    argument(
        metavar="SOURCE",
        help="data set (TUM RGB-D, Replica/NICE-SLAM, ScanNet, one seq-XX of 7-Scenes, Open3D, "
        "ICL-NUIM, KITTI, nerfstudio, Stray Scanner, Record3D or Azure Kinect, recognized by its "
        "files), a bag of ROS, a "
        "recording, or a built-in scene synthetic:NAME; "
        f"NAME is {', '.join(SCENES)}",
    ),
]
Topics = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        name="topic",
        metavar="STREAM=TOPIC",
        help="topic of color, depth or odometry in a bag of ROS, such as color=/front/image_raw; "
        "may be repeated; replaces dataset.topics",
    ),
]
RecordedOdometry = Annotated[
    bool,
    argument(
        help="send the odometry that the source contains, such as the poses of a phone, to the "
        "tracker as odometry prior"
    ),
]
MaxFrames = Annotated[
    int | None, argument(metavar="N", help="stop after N of the frames that --stride selects")
]
Stride = Annotated[int, argument(metavar="N", help="take every N-th frame")]
HoldOutEvery = Annotated[
    int | None,
    argument(metavar="N", help="track every N-th frame but do not map it; 0: map all frames"),
]
Recording = Annotated[
    Path,
    tyro.conf.Positional,
    argument(metavar="DIR", help="folder that `ldo record` wrote"),
]
ActorNames = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="ACTOR",
        help="run only this actor, as part of a running service; may be repeated",
    ),
]
StateFolder = Annotated[
    Path | None,
    argument(
        name="state",
        aliases=["--resume"],
        metavar="DIR",
        help="folder of the actors' checkpoints, from which the actors resume; default: a "
        "temporary folder",
    ),
]
Localize = Annotated[
    Path | None,
    argument(
        metavar="DIR",
        help="localize in the finished map of this run folder, without changing it",
    ),
]
Robot = Annotated[
    str,
    argument(metavar="NAME", help="name of the robot, second part of every topic: ldo/NAME/..."),
]
EndpointAddress = Annotated[
    str, argument(metavar="ADDRESS", help="address of the service's router")
]
KeysFolder = Annotated[
    Path | None,
    argument(
        name="keys",
        metavar="DIR",
        help="folder with TLS keys, made by `ldo keys add`; ADDRESS is then tls/HOST:PORT",
    ),
]
Overwrite = Annotated[bool, argument(help="replace an earlier run in the folder")]
Json = Annotated[bool, argument(help="print one JSON document and nothing else")]


def with_preset(settings: tuple[str, ...], preset: str) -> tuple[str, ...]:
    """Return the settings of --set, preceded by `preset=NAME` if --preset NAME is given."""
    return (f"preset={preset}", *settings) if preset else settings


def with_device(config: Config, device: str | None) -> Config:
    """Return the configuration with the device of --device; None keeps the configured device."""
    if device is None:
        return config
    return checked(replace(config, service=replace(config.service, device=device)))


def with_topics(settings: tuple[str, ...], topics: tuple[str, ...]) -> tuple[str, ...]:
    """Return the settings of --set, followed by `dataset.topics=[...]` if --topic is given."""
    return (*settings, f"dataset.topics=[{', '.join(topics)}]") if topics else settings


def localizing(config: Config, folder: Path | None) -> Config:
    """Return the configuration for localization in the map of a run folder (--localize).

    If the folder is None, the configuration is unchanged.

    Raises:
        DataError: The folder has no map.
    """
    if folder is None:
        return config
    folder = folder.expanduser().resolve()
    load_keyframe_database(folder)
    tracker = replace(config.tracker, localization_map=str(folder))
    return replace(config, tracker=tracker)


def image_size(text: str) -> tuple[int, int]:
    """Return width and height, pixels, from the text WIDTHxHEIGHT of --size.

    Raises:
        ConfigError: The text has another form, or a side is out of range.
    """
    sides = text.split("x")
    if len(sides) != 2 or not all(s.isdecimal() and 1 <= int(s) <= MAX_SIDE_PX for s in sides):
        raise ConfigError(
            f"--size {text} must be WIDTHxHEIGHT, each from 1 to {MAX_SIDE_PX} pixels, such as "
            "640x480."
        )
    return int(sides[0]), int(sides[1])


def note_console() -> Console:
    """Return a console for notes and progress, whose text may contain paths with brackets."""
    return Console(stderr=True, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def progress(title: str, total: int, console: Console) -> Iterator[Advance]:
    """Show progress while the context is open.

    Yields:
        A function that takes the number of finished items and, if the total has grown, the new
        total.
    """
    if not console.is_terminal:
        yield _plain(title, total, console)
        return
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done, total=None: bar.update(task, completed=done, total=total)


def _plain(title: str, total: int, console: Console) -> Advance:
    reported = 0

    def advance(done: int, grown: int | None = None, /) -> None:
        nonlocal reported, total
        if grown not in (None, total):
            reported, total = 0, grown
        if done * LINES // total > reported:
            reported = done * LINES // total
            console.print(f"{title}: {done} of {total}", highlight=False)

    return advance
