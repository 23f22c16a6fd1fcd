"""Arguments that several verbs share."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from ldo_service.actors.detector import require_detector
from ldo_service.actors.vlm_labeller import require_labeller
from ldo_service.config import Config
from ldo_service.tracking.keyframe_database import places_of

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
Only = Annotated[
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
Localise = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="DIR",
        help="track in the map that `ldo run` left in this folder, and do not change it",
    ),
]
Robot = Annotated[
    str, tyro.conf.arg(metavar="NAME", help="second part of every topic: ldo/NAME/...")
]
Endpoint = Annotated[
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


def localising(config: Config, folder: Path | None) -> Config:
    """The configuration with --localise. Raises DataError for a folder without a map."""
    if folder is None:
        return config
    folder = folder.expanduser().resolve()
    places_of(folder)
    tracker = replace(config.tracker, localise=str(folder))
    return replace(config, tracker=tracker)


def with_usable_networks(config: Config) -> Config:
    """The same. Raises ConfigError when a network that it names cannot be used, which a service
    only warns about."""
    require_detector(config.detector)
    require_labeller(config.vlm_labeller)
    return config
