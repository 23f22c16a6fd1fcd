"""Which labels are judged: lists of names, and what data sets and maps call them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO, canonical, coco_class, normalized
from ldo_service.errors import DataError
from ldo_service.geometry.sequence import VOID_NAMES

BACKGROUND = "background"
BUILDING = frozenset({BACKGROUND, "wall", "floor", "ceiling"})  # what no map names
VOID, UNKNOWN = 255, 254  # truth that does not count; a name of the map that is not in the list
MAX_NAMES = UNKNOWN


@dataclass(frozen=True, eq=False, slots=True)
class LabelSet:
    """Names by index, background first.

    name    what to call the list in tables
    place   what a name is called in the list
    """

    name: str
    names: tuple[str, ...]
    place: Callable[[str], str]

    def of_truth(self, class_names: Sequence[str]) -> np.ndarray:
        """[256] uint8, index by class id of the data set; VOID for what does not count."""
        table = np.full(256, VOID, np.uint8)
        for class_id, name in enumerate(class_names):
            if not is_void(name):
                table[class_id] = self.names.index(self.place(name))
        return table

    def of_map(self, names: Sequence[str]) -> np.ndarray:
        """[256] uint8, index by label of the map; UNKNOWN for what the list does not have."""
        table = np.full(256, UNKNOWN, np.uint8)
        for label, name in enumerate(names):
            if self.place(name) in self.names:
                table[label] = self.names.index(self.place(name))
        return table


def coco_list(class_names: Iterable[str]) -> LabelSet:
    """Background and the classes of COCO among those of a data set, by the table of synonyms; all
    that COCO has no class for is background, `other` is unknown."""
    mapped = {coco_class(name) for name in class_names}
    return LabelSet("COCO", (BACKGROUND, *(n for n in COCO if n in mapped)), _in_coco)


def full_list(class_names: Iterable[str]) -> LabelSet:
    """Background and all objects of a data set; those that COCO has a class for go by its name.

    Raises DataError for more than an image of labels can tell apart.
    """
    placed = (place_of_object(name) for name in class_names if not is_void(name))
    names = tuple(dict.fromkeys((BACKGROUND, *placed)))
    if len(names) > MAX_NAMES:
        raise DataError(f"{len(names)} names of objects: at most {MAX_NAMES} can be judged.")
    return LabelSet("all names", names, place_of_object)


def object_labels(map_names: Sequence[str]) -> np.ndarray:
    """[256] uint8, each label of a map as it is; background for what is a part of the building."""
    table = np.arange(256, dtype=np.uint8)
    table[[k for k, name in enumerate(map_names) if place_of_object(name) == BACKGROUND]] = 0
    return table


def is_void(name: str) -> bool:
    return normalized(name) in VOID_NAMES


def place_of_object(name: str) -> str:
    """Its class of COCO where there is one, background for the building, else itself."""
    plain = canonical(name)
    return BACKGROUND if plain in BUILDING else coco_class(plain) or plain


def _in_coco(name: str) -> str:
    plain = canonical(name)
    return plain if plain == "other" else coco_class(plain) or BACKGROUND
