"""Sequences of RGB-D frames: folders in the layouts of the field, and a synthetic room."""

from pathlib import Path

from ldo_service.errors import DataError

from .replica import ReplicaSequence
from .sequence import Cached, Sequence
from .synthetic import SyntheticSequence
from .tum import TumSequence

__all__ = ["Cached", "Sequence", "open_sequence"]

LAYOUTS = (
    "TUM RGB-D (rgb.txt and depth.txt), Replica as NICE-SLAM lays it out (results/frame*.jpg, "
    "results/depth*.png), or the built-in synthetic:room"
)


def open_sequence(source: str) -> Sequence:
    """The frames of a folder, recognised by its layout, or of `synthetic[:name]`.

    Raises DataError naming the known layouts when there is nothing to read.
    """
    scheme, _, name = source.partition(":")
    if scheme == "synthetic":
        return SyntheticSequence.named(name or "room")
    folder = Path(source).expanduser()
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"{source} {found}. A source is a folder in one of the layouts {LAYOUTS}.")
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return TumSequence(folder)
    if (folder / "results").is_dir():
        return ReplicaSequence(folder)
    raise DataError(
        f"{folder} is in no known layout: it has neither rgb.txt with depth.txt nor a folder "
        f"results/. Known layouts: {LAYOUTS}."
    )
