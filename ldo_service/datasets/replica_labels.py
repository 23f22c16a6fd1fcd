"""Labels beside a sequence in Replica's layout, as Habitat renders them.

semantic_class/*.png    8 bits a pixel: the class, by the number of the frame
instance/*.png          16 bits a pixel: the object
labels.json             {"classes": {"<class>": name}}
"""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError

from .calibration import read_json
from .images import read_labels
from .labels import FrameLabels, TrueLabels
from .numbered import numbered

MOST_CLASSES = 256  # of images with 8 bits


class ReplicaLabels:
    """`numbers` [N] are those of the frames."""

    def __init__(self, folder: Path, numbers: np.ndarray) -> None:
        self._folder, self._numbers = folder, numbers

    def read(self) -> TrueLabels | None:
        """None where there are none. Raises DataError for names that make no sense."""
        path = self._folder / "labels.json"
        return TrueLabels(_class_names(path), self.frame) if path.is_file() else None

    def frame(self, index: int) -> FrameLabels:
        """Raises DataError for a frame without labels, FrameError for an image that is none."""
        number = int(self._numbers[index])
        classes, instances = self._files
        if number not in classes or number not in instances:
            raise DataError(
                f"{self._folder} has a labels.json and no labels of frame {number}: expected "
                f"semantic_class/{number:06d}.png and instance/{number:06d}.png."
            )
        class_ids = read_labels(classes[number], np.uint8)
        return FrameLabels(class_ids, read_labels(instances[number], np.uint16))

    @cached_property
    def _files(self) -> tuple[dict[int, Path], dict[int, Path]]:
        classes, instances = self._folder / "semantic_class", self._folder / "instance"
        return numbered(classes, r"(\d+)\.png"), numbered(instances, r"(\d+)\.png")


def _class_names(path: Path) -> tuple[str, ...]:
    """By number; a number without a name is void."""
    found: Any = read_json(path).get("classes")
    try:
        names = {int(number): str(name) for number, name in found.items()}
    except (AttributeError, TypeError, ValueError):
        names = {}
    if not names or not 0 <= min(names) <= max(names) < MOST_CLASSES:
        raise DataError(
            f'{path}: expected "classes", an object of names by numbers from 0 to '
            f"{MOST_CLASSES - 1}."
        )
    return tuple(names.get(number, "") for number in range(max(names) + 1))
