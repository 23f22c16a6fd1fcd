"""Class names of networks and of COCO, their synonyms, and their indices in a map.

`synonyms.yaml` has the table of synonyms and explains its columns.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ldo_service.errors import ConfigError, ModelError

# The 80 classes of COCO (Lin et al., ECCV 2014), in the order that detectors trained on COCO use.
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
LONGEST = 100  # Maximum characters of a name.

TABLE = "synonyms.yaml"

BACKGROUND, OTHER = 0, 1
FIRST_NAMES = ("background", "other", *COCO)
CAP = 256  # Maximum names in a vocabulary, C_max: an index is one byte.


def normalized(name: str) -> str:
    """Return a name in lower case, with one space for each run of spaces, hyphens or underscores.

    "TV-screen" becomes "tv screen".
    """
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def is_name(text: object) -> bool:
    """Return whether a value is a valid name: text of 1 to 100 characters."""
    return isinstance(text, str) and 0 < len(normalized(text)) <= LONGEST


def class_names(
    count: int, given: Sequence[str] = (), metadata: str | None = None
) -> tuple[str, ...]:
    """Return the class names of a network with `count` classes.

    Args:
        count: Number of classes.
        given: Names from the user, which override the names in the metadata; empty: none given.
        metadata: The metadata entry `names` of the network: a dictionary or list as Python source.
            None: the network has no such entry.

    Returns:
        The given names, else the names in the metadata, else the names of COCO if `count` is 80.

    Raises:
        ModelError: If the number of names is not `count`, or there are no names.
    """
    if given:
        return _fitting(tuple(given), count, "the list of names has")
    if metadata is not None:
        return _fitting(_of_metadata(metadata), count, "the entry `names` of its metadata has")
    if count == len(COCO):
        return COCO
    raise ModelError(
        f"the network has {count} classes without names: give a file with one class name per line "
        "(--names of `ldo models add`, or detector.class_names)."
    )


def read_names(path: Path) -> tuple[str, ...]:
    """Read a text file with one name per line; empty lines at the end are ignored.

    Raises:
        ConfigError: If the file cannot be read or a line is not a valid name.
    """
    try:
        lines = path.read_text("utf-8").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"the names in {path} cannot be read: {error}. Give a text file in UTF-8 with one name "
            "per line."
        ) from error
    names = tuple(line.strip() for line in lines)
    for number, name in enumerate(names, 1):
        if not is_name(name):
            raise ConfigError(
                f"line {number} of {path} is not a valid name: write one name of 1 to {LONGEST} "
                "characters per line. The names of a detector must be in the order of its classes."
            )
    return names


def _fitting(names: tuple[str, ...], count: int, who: str) -> tuple[str, ...]:
    if len(names) != count:
        raise ModelError(
            f"the network has {count} classes, but {who} {len(names)} names: give a file with the "
            "names that the network was trained with, one per line."
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
        raise ModelError(
            f"the entry `names` of the network's metadata is {text[:60]!r}. Expected: a list of "
            "class names, or a dictionary of them with the keys 0, 1, 2 and so on. Write the "
            "names into a file, one per line, and run `ldo models add` with `--names FILE`."
        )
    if not all(map(is_name, entry)):
        raise ModelError(
            f"the network's metadata has class names that are not of 1 to {LONGEST} characters: "
            f"{text[:60]!r}. Write the names into a file, one per line, and run "
            "`ldo models add` with `--names FILE`."
        )
    return tuple(entry)


def canonical(name: str) -> str:
    """Return the canonical form of a name, the same for all synonyms: "couch" for "Sofa"."""
    plain = normalized(name)
    return _table("same").get(plain, plain)


def coco_class(name: str) -> str | None:
    """Return the COCO class that covers an object of this name: "dining table" for "desk".

    This is the class that COCO's annotators would have chosen; None if there is no such class.
    """
    plain = canonical(name)
    found = _table("kinds").get(plain, plain)
    return found if found in COCO else None


def answers_to(query: str) -> tuple[str, ...]:
    """Return the class names that match a text query, the best match first.

    The first is the query's canonical name. Next is the COCO class that includes the query, if any,
    because a detector may know only this class. The last are the subclasses of the query.

    The answer to "chair" is "chair" and its subclasses such as "armchair"; the answer to "armchair"
    is "armchair" and "chair".
    """
    plain = canonical(query)
    kinds = _table("kinds")
    above = [kinds[plain]] if plain in kinds else []
    return (plain, *above, *(kind for kind, of in kinds.items() if of == plain))


@cache
def _table(column: str) -> Mapping[str, str]:
    """Return the class of each word in one column of synonyms.yaml, `same` or `kinds`."""
    text = resources.files("ldo_service.detection").joinpath(TABLE).read_text("utf-8")
    rows: dict[str, dict[str, list[str]]] = yaml.safe_load(text)
    return {word: name for name, row in rows.items() for word in row.get(column, ())}


class Vocabulary:
    """Vocabulary of a map: the names of its labels, each with an index.

    The first names are `background`, `other` and the 80 of COCO; new names follow in the order of
    their addition. Synonyms share one index, see `synonyms.yaml`. Once the vocabulary has `cap`
    names, each new name gets the index of `other`.
    """

    def __init__(self, cap: int = CAP) -> None:
        """Create a vocabulary with its initial names: `background`, `other` and those of COCO.

        Args:
            cap: Maximum number of names.

        Raises:
            ConfigError: If the cap is below the number of initial names.
        """
        if cap < len(FIRST_NAMES):
            raise ConfigError(
                f"cap={cap}, the maximum number of names in a vocabulary, must be at least "
                f"{len(FIRST_NAMES)}, the number of its initial names."
            )
        self.cap = cap
        self._names: list[str] = [*FIRST_NAMES]
        self._indices = {name: index for index, name in enumerate(FIRST_NAMES)}
        self.refused = 0  # Number of new names that became `other`.

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: str) -> bool:
        return self.find(name) is not None

    @property
    def names(self) -> tuple[str, ...]:
        """Names by index."""
        return tuple(self._names)

    def name(self, index: int) -> str:
        """Return the name of an index."""
        return self._names[index]

    def find(self, name: str) -> int | None:
        """Return the index of a name or its synonym; None if the vocabulary has neither."""
        return self._indices.get(canonical(name))

    def index(self, name: str) -> int:
        """Return the index of a name, and add the name if it is unknown.

        An empty name gets the index of `other`, and so does an unknown name if the vocabulary is
        full.
        """
        plain = canonical(name)
        if plain in self._indices:
            return self._indices[plain]
        if not plain or len(self) >= self.cap:
            self.refused += 1
            return OTHER
        self._indices[plain] = len(self)
        self._names.append(plain)
        return self._indices[plain]

    def pack(self) -> dict[str, Any]:
        """Return the vocabulary as plain values, for a file or a checkpoint."""
        return {"cap": self.cap, "names": list(self._names), "refused": self.refused}

    @staticmethod
    def unpack(packed: dict[str, Any]) -> "Vocabulary":
        """Restore a vocabulary from `pack`.

        All names keep their indices, even if a newer `synonyms.yaml` makes some of them synonyms.

        Raises:
            ValueError: If the names do not start with the initial names, if a name is repeated, or
                if there are more names than the cap.
        """
        names, vocabulary = packed["names"], Vocabulary(packed["cap"])
        start = len(FIRST_NAMES)
        if tuple(names[:start]) != FIRST_NAMES or not start <= len(names) <= vocabulary.cap:
            raise ValueError(
                f"the stored vocabulary has {len(names)} names. It must begin with background, "
                f"other and the {start - 2} names of COCO, and have at most {vocabulary.cap} names"
            )
        vocabulary._names = list(names)
        vocabulary._indices = {name: index for index, name in enumerate(names)}
        if len(vocabulary._indices) != len(names):
            raise ValueError("a name of the stored vocabulary is repeated; each must occur once")
        vocabulary.refused = packed["refused"]
        return vocabulary


@dataclass(frozen=True, slots=True)
class LabelSources:
    """Labels that the detector and the labeller have given in a map.

    Attributes:
        by_detector: Labels that the detector has given.
        by_labeller: Labels that the labeller has given.
    """

    by_detector: set[int] = field(default_factory=set)
    by_labeller: set[int] = field(default_factory=set)

    def is_labellers(self, label: int) -> bool:
        """Return whether the labeller has given this label and the detector never has."""
        return label in self.by_labeller and label not in self.by_detector

    def undetectable(self) -> np.ndarray | None:
        """Return the labels that only the labeller has given, [256] bool; None if it gave no label.

        The detector never detects objects with these labels, so a missing detection of such an
        object does not count as a miss.
        """
        if not self.by_labeller:
            return None
        return np.array([self.is_labellers(label) for label in range(CAP)])

    def pack(self) -> list[list[int]]:
        """Return the labels from the detector and those from the labeller, each list sorted."""
        return [sorted(self.by_detector), sorted(self.by_labeller)]

    @staticmethod
    def unpack(packed: Sequence[Sequence[int]]) -> "LabelSources":
        """Restore the sources from `pack`."""
        return LabelSources(*map(set, packed))
