"""Sequences of RGB-D frames: folders in common data-set layouts, and synthetic scenes."""

from pathlib import Path

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry.sequence import Cached, Sequence
from ldo_service.synthetic import SCENES, open_synthetic

from .replica import ReplicaSequence
from .rig import SequenceOptions
from .scannet import ScanNetSequence
from .seven_scenes import SevenScenesSequence
from .tum import TumSequence

__all__ = ["Cached", "Sequence", "SequenceOptions", "open_sequence"]

LAYOUTS = (
    "TUM RGB-D (rgb.txt and depth.txt), Replica as NICE-SLAM lays it out (results/frame*.jpg, "
    "results/depth*.png), ScanNet as SensReader exports it (color/*.jpg, depth/*.png, "
    "intrinsic/), a seq-XX of 7-Scenes (frame-*.color.png, frame-*.depth.png), or a built-in "
    f"scene synthetic:NAME, where NAME is {', '.join(SCENES)}"
)


def open_sequence(source: str, options: SequenceOptions | None = None) -> Sequence:
    """Open a sequence of frames.

    Args:
        source: A folder, whose layout is detected, or `synthetic[:name]`.
        options: Registration of depth to color; None uses the defaults. Options other than the
            defaults are valid for ScanNet and 7-Scenes only, which have two cameras.

    Raises:
        DataError: The source does not exist or has no known layout.
        ConfigError: The layout does not support the options.
    """
    options = options or SequenceOptions()
    scheme, _, name = source.partition(":")
    if scheme == "synthetic":
        _refuse(options, source)
        return open_synthetic(name or "room")
    folder = Path(source).expanduser()
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"{source} {found}. Expected a folder in one of these layouts: {LAYOUTS}.")
    return _open_folder(folder, options)


def _open_folder(folder: Path, options: SequenceOptions) -> Sequence:
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        _refuse(options, f"{folder} (TUM RGB-D)")
        return TumSequence(folder)
    if (folder / "results").is_dir():
        _refuse(options, f"{folder} (Replica)")
        return ReplicaSequence(folder)
    if (folder / "color").is_dir() and (folder / "depth").is_dir():
        return ScanNetSequence(folder, options)
    if any(folder.glob("frame-*.color.*")):
        return SevenScenesSequence(folder, options)
    if parts := sorted(path.parent.name for path in folder.glob("seq-*/frame-000000.color.*")):
        raise DataError(
            f"{folder} contains several sequences of 7-Scenes. Give one of them, such as "
            f"{folder / parts[0]}."
        )
    raise DataError(
        f"{folder} has no known layout: it has neither rgb.txt with depth.txt nor a folder "
        "results/, nor the folders color/ and depth/, nor files frame-*.color.*. Known layouts: "
        f"{LAYOUTS}."
    )


def _refuse(options: SequenceOptions, source: str) -> None:
    if not options.is_default:
        raise ConfigError(
            f"the depth of {source} is registered to color already. Remove the registration "
            "options, which are for ScanNet and 7-Scenes only."
        )
