"""Label lists for evaluation: their names, and the mappings from data sets and maps to them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO, canonical, coco_class, normalized
from ldo_service.errors import DataError
from ldo_service.geometry.sequence import VOID_NAMES

BACKGROUND = "background"
BUILDING = frozenset({BACKGROUND, "wall", "floor", "ceiling"})  # Names that no map uses.
VOID, UNKNOWN = 255, 254  # Ignored ground truth; a name of the map that is not in the list.
MAX_NAMES = UNKNOWN


@dataclass(frozen=True, eq=False, slots=True)
class LabelSet:
    """Names by index, background first.

    Attributes:
        name: Name of the list in tables.
        names: The names.
        place: Function from any name to the corresponding name in the list.
    """

    name: str
    names: tuple[str, ...]
    place: Callable[[str], str]

    def of_truth(self, class_names: Sequence[str]) -> np.ndarray:
        """Return the list index by class id of the data set, [256] uint8.

        It is VOID for ignored classes.
        """
        table = np.full(256, VOID, np.uint8)
        for class_id, name in enumerate(class_names):
            if not is_void(name):
                table[class_id] = self.names.index(self.place(name))
        return table

    def of_map(self, names: Sequence[str]) -> np.ndarray:
        """Return the list index by label of the map, [256] uint8.

        It is UNKNOWN for names that are not in the list.
        """
        table = np.full(256, UNKNOWN, np.uint8)
        for label, name in enumerate(names):
            if self.place(name) in self.names:
                table[label] = self.names.index(self.place(name))
        return table


def coco_list(class_names: Iterable[str]) -> LabelSet:
    """Return background and the COCO classes that a data set contains, by the table of synonyms.

    Names without a COCO class map to background. The name `other` is not in the list.
    """
    mapped = {coco_class(name) for name in class_names}
    return LabelSet("COCO", (BACKGROUND, *(n for n in COCO if n in mapped)), _in_coco)


def full_list(class_names: Iterable[str]) -> LabelSet:
    """Return background and all object names of a data set.

    Objects with a COCO class get its name.

    Raises:
        DataError: There are more names than a label image can hold.
    """
    placed = (place_of_object(name) for name in class_names if not is_void(name))
    names = tuple(dict.fromkeys((BACKGROUND, *placed)))
    if len(names) > MAX_NAMES:
        raise DataError(f"{len(names)} object names; at most {MAX_NAMES} can be evaluated.")
    return LabelSet("all names", names, place_of_object)


def object_labels(map_names: Sequence[str]) -> np.ndarray:
    """Return a table [256] uint8 from labels of a map to object labels.

    Labels of building parts become background; the others stay.
    """
    table = np.arange(256, dtype=np.uint8)
    table[[k for k, name in enumerate(map_names) if place_of_object(name) == BACKGROUND]] = 0
    return table


def is_void(name: str) -> bool:
    """Return whether a name of a data set means that its pixels are not labelled."""
    return normalized(name) in VOID_NAMES


def place_of_object(name: str) -> str:
    """Return the name in the full list of any name.

    It is the COCO class if there is one, background for the building, else the name itself.
    """
    plain = canonical(name)
    return BACKGROUND if plain in BUILDING else coco_class(plain) or plain


def _in_coco(name: str) -> str:
    plain = canonical(name)
    return plain if plain == "other" else coco_class(plain) or BACKGROUND
