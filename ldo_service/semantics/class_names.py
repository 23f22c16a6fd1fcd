"""What a network calls its classes: from a file, from its metadata, or those of COCO."""

import ast
from collections.abc import Sequence
from pathlib import Path

from ldo_service.errors import ConfigError, ModelError

# Lin et al., ECCV 2014; the 80 in use, in the order of every detector trained on them.
COCO = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog",
    "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella",
    "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite",
    "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich", "orange",
    "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch", "potted plant",
    "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard", "cell phone",
    "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
LONGEST = 100  # characters of a name


def normalised(name: str) -> str:
    """In lower case, with single spaces for spaces, hyphens and underscores: "TV-screen" is
    "tv screen"."""
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def is_name(text: object) -> bool:
    return isinstance(text, str) and 0 < len(normalised(text)) <= LONGEST


def class_names(
    count: int, given: Sequence[str] = (), metadata: str | None = None
) -> tuple[str, ...]:
    """Names of the classes of a network that has `count`.

    given     those of the user; they come first
    metadata  the entry `names` that exporters write, a dictionary or list of Python

    Raises ModelError when there are others than it has classes, or none.
    """
    if given:
        return _fitting(tuple(given), count, "the file of names has")
    if metadata is not None:
        return _fitting(_of_metadata(metadata), count, "its metadata names")
    if count == len(COCO):
        return COCO
    raise ModelError(
        f"it has {count} classes and does not name them: give a file of names, one a line."
    )


def read_names(path: Path) -> tuple[str, ...]:
    """One a line; empty lines at the end are left out. Raises ConfigError."""
    try:
        lines = path.read_text("utf-8").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the names in {path} cannot be read: {error}.") from error
    names = tuple(line.strip() for line in lines)
    for number, name in enumerate(names, 1):
        if not is_name(name):
            raise ConfigError(
                f"line {number} of {path} is no name: write one of 1 to {LONGEST} characters a "
                "line, in the order of the network's classes."
            )
    return names


def _fitting(names: tuple[str, ...], count: int, who: str) -> tuple[str, ...]:
    if len(names) != count:
        raise ModelError(
            f"it has {count} classes and {who} {len(names)}: give the names that it was trained "
            "with, one a line."
        )
    return names


def _of_metadata(text: str) -> tuple[str, ...]:
    try:
        entry = ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
        entry = None
    if isinstance(entry, dict) and set(entry) == set(range(len(entry))):
        entry = [entry[number] for number in range(len(entry))]
    if not isinstance(entry, list | tuple):
        raise ModelError(f"its metadata names no classes: {text[:60]!r}.")
    if not all(map(is_name, entry)):
        raise ModelError(f"its metadata has names that are none: {text[:60]!r}.")
    return tuple(entry)
