"""Class names: those of networks and of COCO, their synonyms, and their indices in a map.

The table of synonyms and its rule are in `synonyms.yaml`.
"""

import ast
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

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

TABLE = "synonyms.yaml"

BACKGROUND, OTHER = 0, 1
FIRST_NAMES = ("background", "other", *COCO)
CAP = 256  # C_max: what one byte can number


def normalized(name: str) -> str:
    """In lower case, with single spaces for spaces, hyphens and underscores: "TV-screen" is
    "tv screen"."""
    return " ".join(name.casefold().replace("_", " ").replace("-", " ").split())


def is_name(text: object) -> bool:
    return isinstance(text, str) and 0 < len(normalized(text)) <= LONGEST


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


def canonical(name: str) -> str:
    """The one name of those that mean the same: "Sofa" is "couch"."""
    plain = normalized(name)
    return _table("same").get(plain, plain)


def coco_class(name: str) -> str | None:
    """The class of COCO that its annotators would have used: "desk" is "dining table".

    None for what COCO has no class for.
    """
    plain = canonical(name)
    found = _table("kinds").get(plain, plain)
    return found if found in COCO else None


def answers_to(query: str) -> tuple[str, ...]:
    """Names of what somebody means who asks for `query`, nearest first: the thing itself, the class
    of COCO whose kind it is, for detectors know no finer word, and its own kinds."""
    plain = canonical(query)
    kinds = _table("kinds")
    above = [kinds[plain]] if plain in kinds else []
    return (plain, *above, *(kind for kind, of in kinds.items() if of == plain))


@cache
def _table(column: str) -> Mapping[str, str]:
    """Class by word, of the column `same` or `kinds`."""
    text = resources.files("ldo_service.detection").joinpath(TABLE).read_text("utf-8")
    rows: dict[str, dict[str, list[str]]] = yaml.safe_load(text)
    return {word: name for name, row in rows.items() for word in row.get(column, ())}


class Vocabulary:
    """`background`, `other`, the 80 names of COCO, then every new name in the order it comes.

    Names that mean the same share an index, see `synonyms`. Beyond `cap` names, a new one is
    `other`.

    Raises ConfigError for a cap below the names it starts with.
    """

    def __init__(self, cap: int = CAP) -> None:
        if cap < len(FIRST_NAMES):
            raise ConfigError(
                f"a vocabulary of {cap} has no room for the {len(FIRST_NAMES)} names it starts "
                "with: raise the cap."
            )
        self.cap = cap
        self._names: list[str] = [*FIRST_NAMES]
        self._indices = {name: index for index, name in enumerate(FIRST_NAMES)}
        self.refused = 0  # times that a new name became `other`

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: str) -> bool:
        return self.find(name) is not None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._names)

    def name(self, index: int) -> str:
        return self._names[index]

    def find(self, name: str) -> int | None:
        """The index of a known name; None for one that is not known."""
        return self._indices.get(canonical(name))

    def index(self, name: str) -> int:
        """The index of a name, which is new from now on if it was not known; `other` when there is
        no room, or no name."""
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
        """Plain values, for a file or a state."""
        return {"cap": self.cap, "names": list(self._names), "refused": self.refused}

    @staticmethod
    def unpack(packed: dict[str, Any]) -> "Vocabulary":
        """As it was, whatever has become a synonym since. Raises ValueError when these are not the
        names of a vocabulary."""
        names, vocabulary = packed["names"], Vocabulary(packed["cap"])
        start = len(FIRST_NAMES)
        if tuple(names[:start]) != FIRST_NAMES or not start <= len(names) <= vocabulary.cap:
            raise ValueError(f"{len(names)} names, not those that every vocabulary starts with")
        vocabulary._names = list(names)
        vocabulary._indices = {name: index for index, name in enumerate(names)}
        if len(vocabulary._indices) != len(names):
            raise ValueError("the vocabulary has a name twice")
        vocabulary.refused = packed["refused"]
        return vocabulary
