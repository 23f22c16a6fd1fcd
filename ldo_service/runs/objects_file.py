"""objects.json of a run: the objects of its map, in the map's frame.

It is the message `map/objects` as it is on the network, in JSON: `objects` is a list of

    id, name, confidence      stays what it is during a run; the likeliest class, 0..1
    centroid, covariance      of the Gaussians, m, and m^2 (9 numbers, row by row)
    T_map_object, size        of the box: its centre, its axes (quaternion wxyz), and extents, m
    distribution, entropy     [name, probability] of the likeliest classes; nats
    seen, missed              keyframes that saw it, and that ought to have
    first_keyframe, last_keyframe   that saw it
    views                     keyframes that show it best, with box_px
"""

from pathlib import Path

import msgspec

from ldo_service.errors import DataError
from ldo_service.schemas import MapObjects

OBJECTS = "objects.json"


def write_objects(folder: Path, objects: MapObjects) -> None:
    """The same objects give the same bytes."""
    text = msgspec.json.format(msgspec.json.encode(objects), indent=1)
    (folder / OBJECTS).write_bytes(text + b"\n")


def refuse_state(folder: Path) -> None:
    """Raises DataError for a folder where a service keeps its state."""
    if (folder / "state").is_dir():
        raise DataError(
            f"{folder} holds the state of a service, and nothing that `ldo run` writes: "
            f"`ldo serve --resume {folder}` goes on with it, and `live` names that service here."
        )


def read_objects(folder: Path) -> MapObjects:
    """Raises DataError when there is no such file, or it is not what `write_objects` writes."""
    path = folder / OBJECTS
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder: name that of a finished `ldo run`, or `live`.")
    if not path.is_file():
        refuse_state(folder)
        raise DataError(
            f"{folder} has no {OBJECTS}: the run kept no objects, which takes a detector. "
            "`ldo run` the sequence again with detector.model set; `ldo models` tells how."
        )
    try:
        return msgspec.json.decode(path.read_bytes(), type=MapObjects)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"{path} is not what `ldo run` writes: {error}.") from error
