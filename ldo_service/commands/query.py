"""ldo query"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.actors.vlm_labeller import VlmLabellerConfig
from ldo_service.client import connect
from ldo_service.config import actor_parameters, load_config
from ldo_service.conversions.poses import pose_from_message
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig
from ldo_service.detection.model_registry import open_labeller
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.maps.object_search import ObjectMatch, find_objects
from ldo_service.runs.records import read_objects
from ldo_service.schemas import MapObjects, TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.semantics.text_search import Encode, TextComparisonError
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT

from .options import EndpointAddress, Json, KeysFolder, Robot

LIVE = "live"


def query(
    where: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="DIR|live", help="folder of a finished run, or the running service"),
    ],
    text: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TEXT", help="its name")],
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    model: Annotated[
        str,
        tyro.conf.arg(
            metavar="NAME",
            help="pair of encoders that compares words where none in the map says the same; of a "
            "run, the labeller that it had",
        ),
    ] = "",
    json_: Annotated[Json, tyro.conf.arg(name="json")] = False,
) -> None:
    """Tell where things are: boxes in the map, the likeliest first.

    Other words for the same are understood, and kinds of it: "sofa" finds couches. What no table
    of words knows is compared by the texts of an image-text model, where there is one.

      ldo query DIR "potted plant"
      ldo query live chair --json
      ldo query live "something to sit on" --model mobileclip
    """
    is_live = where == LIVE
    found, eye = _live(robot, endpoint, keys) if is_live else _of_run(Path(where).expanduser())
    encode = _texts_of(model, None if is_live else Path(where).expanduser())
    answers = find_objects(text, found, eye, encode)
    if json_:
        print(json.dumps([_plain(one) for one in answers]))
    else:
        Console(highlight=False, markup=False).print(_table(answers))


def _of_run(folder: Path) -> tuple[MapObjects, np.ndarray | None]:
    """The objects, and where the camera was at the end."""
    found, path = read_objects(folder), folder / "trajectory.txt"
    T_map_camera = Trajectory.load(path).T_world_camera if path.is_file() else np.zeros((0, 4, 4))
    return found, T_map_camera[-1, :3, 3] if len(T_map_camera) else None


def _live(robot: str, endpoint: str, keys: Path | None) -> tuple[MapObjects, np.ndarray | None]:
    """The objects, and where the camera is."""
    with connect(robot, endpoint, keys) as service:
        found, poses = service.objects(), service.latest(POSE_TRACKED)
    eye = None
    for pose in poses:
        assert isinstance(pose, TrackedPose)
        if pose.submap:
            continue  # where that is in the map is not known
        eye = (pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera))[:3, 3]
    return found, eye


def _texts_of(model: str, run: Path | None) -> Encode:
    """Of a pair, or where none is named of the labeller that a run had. It is opened when it is
    asked: a name that cannot be opened is a ConfigError then; a run's labeller may be gone."""

    def encode(texts: Sequence[str]) -> np.ndarray:
        if model:
            return open_labeller(model, DualEncoderConfig()).texts.encode(texts)
        had = None if run is None else _labeller_of(run)
        if had is None:
            raise TextComparisonError("`--model NAME` names a pair of encoders that can.")
        try:
            return open_labeller(had.model, had.dual_encoder).texts.encode(texts)
        except ConfigError as error:
            raise TextComparisonError(f"{error} `--model NAME` names another pair.") from error

    return encode


def _labeller_of(run: Path) -> VlmLabellerConfig | None:
    """Return the settings of the run's labeller; None where it had no pair.

    Raises:
        NotCompared: The configuration of the run cannot be read, or is of an earlier version.
    """
    try:
        config = actor_parameters(load_config(run / "config.yaml")).vlm_labeller
    except ConfigError as error:
        raise TextComparisonError(
            f"{run / 'config.yaml'}: {error} `--model NAME` names a pair."
        ) from error
    return config if config.model else None


def _plain(one: ObjectMatch) -> dict[str, object]:
    pose = one.T_map_object
    return {
        **{name: value for name, value in asdict(one).items() if name != "T_map_object"},
        "quaternion_wxyz": pose.quaternion,
    }


def _table(answers: list[ObjectMatch]) -> Table:
    table = Table("id", "name", "score", "centre m", "size m", "distance m")
    for one in answers:
        away = "" if one.distance is None else f"{one.distance:.2f}"
        lengths = (" ".join(f"{v:.2f}" for v in vector) for vector in (one.center, one.size))
        table.add_row(str(one.id), one.name, f"{one.score:.2f}", *lengths, away)
    return table
