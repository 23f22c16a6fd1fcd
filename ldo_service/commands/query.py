"""Command `ldo query`: find objects of a map by name."""

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
from ldo_service.detection.model_registry import Models
from ldo_service.detection.open_networks import open_labeller
from ldo_service.detection.sentence_models import open_sentence_encoder, sentence_encoders
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.maps.object_search import ObjectMatch, find_objects
from ldo_service.runs.records import read_objects
from ldo_service.schemas import MapObjects, TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.semantics.text_search import (
    MIN_COSINE,
    Encode,
    TextComparisonError,
    TextEncoder,
)
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT

from .options import EndpointAddress, Json, KeysFolder, Robot, argument

LIVE = "live"


def query(
    where: Annotated[
        str,
        tyro.conf.Positional,
        argument(metavar="DIR|live", help="folder of a finished run, or the running service"),
    ],
    text: Annotated[str, tyro.conf.Positional, argument(metavar="TEXT", help="name of the object")],
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    model: Annotated[
        str,
        argument(
            metavar="NAME",
            help="sentence encoder or encoder pair that compares TEXT with the names of the "
            "objects if none matches; default: the only registered sentence encoder or, for a run, "
            "the labeller of the run",
        ),
    ] = "",
    json_: Annotated[Json, argument(name="json")] = False,
) -> None:
    """Find objects by name: print their boxes in the map, best match first.

    The search also uses synonyms, broader terms and narrower terms of TEXT: "sofa" finds couches.
    If no object matches, a text encoder searches for names of similar meaning. --model chooses the
    encoder.

      ldo query DIR "potted plant"
      ldo query live chair --json
      ldo query live "something to sit on" --model minilm
    """
    is_live = where == LIVE
    found, eye = _live(robot, endpoint, keys) if is_live else _of_run(Path(where).expanduser())
    encoder = _encoder(model, None if is_live else Path(where).expanduser())
    answers = find_objects(text, found, eye, encoder)
    if json_:
        print(json.dumps([_plain(one) for one in answers]))
    else:
        Console(highlight=False, markup=False).print(_table(answers))


def _of_run(folder: Path) -> tuple[MapObjects, np.ndarray | None]:
    """Return the objects of a run, and the last position [3] of the camera in the map, meters.

    The position is None if the run has no poses.
    """
    found, path = read_objects(folder), folder / "trajectory.txt"
    T_map_camera = Trajectory.load(path).T_world_camera if path.is_file() else np.zeros((0, 4, 4))
    return found, T_map_camera[-1, :3, 3] if len(T_map_camera) else None


def _live(robot: str, endpoint: str, keys: Path | None) -> tuple[MapObjects, np.ndarray | None]:
    """Return the objects of a service, and the position [3] of the camera in the map, meters.

    The position is None if it is unknown.
    """
    with connect(robot, endpoint, keys) as service:
        found, poses = service.objects(), service.latest(POSE_TRACKED)
    eye = None
    for pose in poses:
        assert isinstance(pose, TrackedPose)
        if pose.submap:
            continue  # The submap is not merged, so its pose in the map is unknown.
        eye = (pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera))[:3, 3]
    return found, eye


def _encoder(model: str, run: Path | None) -> TextEncoder:
    """Return the text encoder of a query.

    Args:
        model: Name of a sentence encoder or of an encoder pair; empty to use the only registered
            sentence encoder or, without one, the labeller of the run.
        run: Folder of the run; None for a live service.
    """
    models = Models()
    found = sentence_encoders(models)
    if model not in found and (model or not found):
        return TextEncoder(_texts_of(model, run), MIN_COSINE)

    def encode(texts: Sequence[str]) -> np.ndarray:
        if model:
            return open_sentence_encoder(models, model).encode(texts)
        if len(found) > 1:
            raise TextComparisonError(
                f"several sentence encoders are registered: {', '.join(found)}. Choose one with "
                "`--model NAME`."
            )
        try:
            return open_sentence_encoder(models, found[0]).encode(texts)
        except ConfigError as error:
            raise TextComparisonError(str(error)) from error

    return TextEncoder(encode)


def _texts_of(model: str, run: Path | None) -> Encode:
    """Return a function that encodes texts with an encoder pair.

    The returned function opens the pair when it is called, because most queries do not need the
    pair, and the labeller of a run may no longer exist.

    Args:
        model: Name of the encoder pair; empty to use the labeller of the run.
        run: Folder of the run; None for a live service.

    Returns:
        The function. It raises ConfigError if `model` cannot be opened. It raises
        TextComparisonError if `model` is empty and the run has no pair that can be opened.
    """

    def encode(texts: Sequence[str]) -> np.ndarray:
        if model:
            return open_labeller(model, DualEncoderConfig()).texts.encode(texts)
        had = None if run is None else _labeller_of(run)
        if had is None:
            what = "the query of a live service" if run is None else "the labeller of this run"
            raise TextComparisonError(
                f"comparing the text with object names needs a text encoder, and {what} has none. "
                "Register a sentence encoder with `ldo models add NAME FILE --tokenizer FILE`, or "
                "choose a registered encoder pair with `--model NAME`."
            )
        try:
            return open_labeller(had.model, had.dual_encoder).texts.encode(texts)
        except ConfigError as error:
            raise TextComparisonError(
                f"{error} Choose another encoder pair with `--model NAME`."
            ) from error

    return encode


def _labeller_of(run: Path) -> VlmLabellerConfig | None:
    """Return the settings of the run's labeller; None if the run had no encoder pair.

    Raises:
        TextComparisonError: The configuration of the run cannot be read, or is of an earlier
            version.
    """
    try:
        config = actor_parameters(load_config(run / "config.yaml")).vlm_labeller
    except ConfigError as error:
        raise TextComparisonError(
            f"the labeller of the run in {run} is unknown: {error} Choose an encoder pair with "
            "`--model NAME`."
        ) from error
    return config if config.model else None


def _plain(one: ObjectMatch) -> dict[str, object]:
    pose = one.T_map_object
    return {
        **{name: value for name, value in asdict(one).items() if name != "T_map_object"},
        "quaternion_wxyz": pose.quaternion,
    }


def _table(answers: list[ObjectMatch]) -> Table:
    table = Table("id", "name", "score", "center m", "size m", "distance m")
    for one in answers:
        away = "" if one.distance is None else f"{one.distance:.2f}"
        lengths = (" ".join(f"{v:.2f}" for v in vector) for vector in (one.center, one.size))
        table.add_row(str(one.id), one.name, f"{one.score:.2f}", *lengths, away)
    return table
