"""Names beyond those of COCO: which objects have them in the map, and which of them are right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.detection.vocabulary import COCO
from ldo_service.geometry.sequence import FrameLabels

from .label_lists import BACKGROUND, VOID, LabelList, place_of_object

LEAST_SHARE = 0.005  # of the pixels of a view: an object smaller than that need not be found


@dataclass(frozen=True, slots=True)
class Found:
    """right of `wanted` that there are, and of `named` that are said to be."""

    right: int = 0
    wanted: int = 0
    named: int = 0

    def __add__(self, other: "Found") -> "Found":
        return Found(self.right + other.right, self.wanted + other.wanted, self.named + other.named)

    @property
    def recall(self) -> float:
        return self.right / self.wanted if self.wanted else float("nan")

    @property
    def precision(self) -> float:
        return self.right / self.named if self.named else float("nan")


class OpenNames:
    """Counts pixels, and what the pixels of each true object are shown as, view by view.

    An object is called what most of its pixels are, over all views in which it has 0.5 % of the
    pixels. What a data set has as an instance is an object here, be it a part of the building: a
    wall can be called by a wrong name.
    """

    def __init__(self, labels: LabelList, map_names: Sequence[str]) -> None:
        """`labels` is the full list of a data set, `map_names` are by label of the map."""
        self.pixels = Found()
        self._of_map = labels.of_map(map_names)
        self._is_named = _table(map_names)
        self._is_wanted = _table(labels.names)
        self._votes: dict[int, np.ndarray] = {}  # [256] pixels by label of the map, by instance
        self._truth: dict[int, int] = {}  # index in the list, by instance

    def add(self, frame: FrameLabels, truth: np.ndarray, shown: np.ndarray) -> None:
        """truth [H, W] uint8, index in the list or VOID; shown [H, W] uint8, label of the map."""
        self._add_pixels(truth, shown)
        sizes = np.bincount(frame.instance_ids.ravel())
        for instance in np.flatnonzero(sizes >= LEAST_SHARE * truth.size).tolist():
            mask = (frame.instance_ids == instance) & (truth != VOID)
            if mask.any():
                votes = np.bincount(shown[mask], minlength=256)
                self._votes[instance] = self._votes.get(instance, 0) + votes
                self._truth[instance] = int(np.bincount(truth[mask]).argmax())

    def _add_pixels(self, truth: np.ndarray, shown: np.ndarray) -> None:
        counted = truth != VOID
        truth, shown = truth[counted], shown[counted]
        named, wanted = self._is_named[shown], self._is_wanted[truth]
        right = named & (self._of_map[shown] == truth)
        self.pixels += Found(*(int(np.count_nonzero(kind)) for kind in (right, wanted, named)))

    @property
    def objects(self) -> Found:
        called = {instance: int(votes.argmax()) for instance, votes in self._votes.items()}
        named = [instance for instance, label in called.items() if self._is_named[label]]
        right = [i for i in named if self._of_map[called[i]] == self._truth[i]]
        wanted = [truth for truth in self._truth.values() if self._is_wanted[truth]]
        return Found(len(right), len(wanted), len(named))


def is_beyond_coco(name: str) -> bool:
    """Whether it is the name of an object that COCO has no class for."""
    return place_of_object(name) not in (BACKGROUND, "other", *COCO)


def _table(names: Sequence[str]) -> np.ndarray:
    """[256] bool, by index."""
    table = np.zeros(256, bool)
    table[: len(names)] = [is_beyond_coco(name) for name in names]
    return table
