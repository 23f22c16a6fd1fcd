"""Lists of label names for evaluation, and tables that convert labels to list indices."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.detection.vocabulary import (
    COCO,
    answers_to,
    canonical,
    coco_class,
    normalized,
    read_names,
)
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry.sequence import VOID_NAMES

COCO_NAME, ALL_NAMES = "COCO", "all names"  # Names of the lists that are always evaluated.
HERE = Path(__file__).parent / "classes"  # Lists of class names, one file for each list.
BACKGROUND = "background"
BUILDING = frozenset({BACKGROUND, "wall", "floor", "ceiling"})  # Names evaluated as background.
# Indices for ground truth that is ignored, and for a name of the map that is not in the list.
VOID, UNKNOWN = 255, 254
MAX_NAMES = UNKNOWN
# Classes of NYU40 that collect objects of any name.
COLLECTIVE = frozenset({"otherstructure", "otherfurniture", "otherprop"})


@dataclass(frozen=True, eq=False, slots=True)
class LabelSet:
    """List of the label names of an evaluation, background first.

    Attributes:
        name: Name of the list in tables of results.
        names: The label names by index.
        listed_name: Function that maps any label name to the corresponding name in the list.
    """

    name: str
    names: tuple[str, ...]
    listed_name: Callable[[str], str]

    def of_truth(self, class_names: Sequence[str]) -> np.ndarray:
        """Return a table from class ids of the data set to indices in the list, [256] uint8.

        Classes that the evaluation ignores get the index VOID (255). These are classes without a
        label, and classes that are not in the list.
        """
        table = np.full(256, VOID, np.uint8)
        for class_id, name in enumerate(class_names):
            if not is_void(name) and (listed := self.listed_name(name)) in self.names:
                table[class_id] = self.names.index(listed)
        return table

    def of_map(self, names: Sequence[str]) -> np.ndarray:
        """Return a table from labels of the map to indices in the list, [256] uint8.

        Labels whose name is not in the list get the index UNKNOWN (254).
        """
        table = np.full(256, UNKNOWN, np.uint8)
        for label, name in enumerate(names):
            if self.listed_name(name) in self.names:
                table[label] = self.names.index(self.listed_name(name))
        return table


def coco_list(class_names: Iterable[str]) -> LabelSet:
    """Return a list of names: background, then the COCO classes that a data set contains.

    A table of synonyms converts names of the data set to COCO classes. Names without a COCO class
    become background. The map labels an object without a known name as `other`. This label is not
    in the list and therefore always counts as wrong.

    Args:
        class_names: Names of the classes of the data set.
    """
    mapped = {coco_class(name) for name in class_names}
    return LabelSet(COCO_NAME, (BACKGROUND, *(n for n in COCO if n in mapped)), _in_coco)


def full_list(class_names: Iterable[str]) -> LabelSet:
    """Return a list of names: background, then all object names of a data set.

    An object that has a COCO class is listed under the name of that class.

    Args:
        class_names: Names of the classes of the data set.

    Raises:
        DataError: If there are more names than a label image can hold.
    """
    placed = (object_name(name) for name in class_names if not is_void(name))
    names = tuple(dict.fromkeys((BACKGROUND, *placed)))
    if len(names) > MAX_NAMES:
        raise DataError(
            f"the data set has {len(names)} object names, expected at most {MAX_NAMES}. Merge "
            "some of its classes."
        )
    return LabelSet(ALL_NAMES, names, object_name)


def known_lists() -> list[str]:
    """Return the names of the class lists of this package."""
    return sorted(path.stem for path in HERE.glob("*.txt"))


def load_classes(name: str) -> LabelSet:
    """Return a class list of this package, or the list in a text file with one name per line.

    Walls, floors and ceilings are background, and collective classes such as `otherprop` are left
    out. Labels of data sets and maps are converted by the table of synonyms. A name that is not in
    the list is converted to a class of the list with the same COCO class, the first one in the
    table of synonyms: "dining table" becomes "table". Spaces are ignored.

    Args:
        name: Name of a list, such as "nyu40", or path of a text file.

    Raises:
        ConfigError: There is no such list, or the file is invalid.
    """
    path = HERE / f"{name}.txt" if name in known_lists() else Path(name).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"there is no list of classes {name}. Give a text file with one name per line, or one "
            f"of {', '.join(known_lists())}."
        )
    listed = [canonical(line) for line in read_names(path) if not is_void(line)]
    names = tuple(dict.fromkeys((BACKGROUND, *(n for n in listed if n not in BUILDING))))
    if not 1 < len(names) <= MAX_NAMES:
        raise ConfigError(
            f"{path} has {len(names) - 1} names of objects, must have 1 to {MAX_NAMES - 1}. Remove "
            "or add names."
        )
    if path.stem in (COCO_NAME, ALL_NAMES):
        raise ConfigError(
            f"{path} has the name of a list that is always evaluated. Give it another name."
        )
    without_spaces = {name.replace(" ", ""): name for name in names}
    by_coco: dict[str, str] = {}
    for coco_name in dict.fromkeys(map(coco_class, names)):
        if coco_name is not None:
            known = (word for word in answers_to(coco_name) if word in names)
            by_coco[coco_name] = next(known)

    def listed_name_of(name: str) -> str:
        plain = canonical(name)
        if plain in BUILDING:
            return BACKGROUND
        listed = without_spaces.get(plain.replace(" ", ""))
        return listed or by_coco.get(coco_class(plain) or "", plain)

    return LabelSet(path.stem, names, listed_name_of)


def object_labels(map_names: Sequence[str]) -> np.ndarray:
    """Return a table [256] uint8 that replaces the labels of building parts in a map by background.

    Building parts are walls, floors and ceilings. All other labels stay unchanged.
    """
    table = np.arange(256, dtype=np.uint8)
    table[[k for k, name in enumerate(map_names) if object_name(name) == BACKGROUND]] = 0
    return table


def is_void(name: str) -> bool:
    """Return whether pixels of a class of a data set are ignored.

    They are ignored if the class means no label, such as `void`, or any object, such as
    `otherprop`.
    """
    return normalized(name) in VOID_NAMES | COLLECTIVE


def object_name(name: str) -> str:
    """Return the name that stands for a label name in the list of `full_list`.

    The name of a building part, such as wall, becomes background. Any other name becomes the name
    of its COCO class. A name without a COCO class becomes its canonical form.
    """
    plain = canonical(name)
    return BACKGROUND if plain in BUILDING else coco_class(plain) or plain


def _in_coco(name: str) -> str:
    plain = canonical(name)
    return plain if plain == "other" else coco_class(plain) or BACKGROUND
