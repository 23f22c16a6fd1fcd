"""What the pixels of a frame truly are, where a data set says so."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

VOID_NAMES = frozenset({"", "undefined", "unknown", "unlabeled", "unlabelled", "void"})


@dataclass(frozen=True, eq=False, slots=True)
class FrameLabels:
    """What each pixel shows.

    class_ids      [H, W] uint8, index into the class names of the data set
    instance_ids   [H, W] uint16, one number for each object; 0 for what is none
    """

    class_ids: np.ndarray
    instance_ids: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class TrueLabels:
    """class_names  by class id; pixels of those among VOID_NAMES may be anything
    frame        the labels of frame `index`, on its pixels; raises FrameError"""

    class_names: tuple[str, ...]
    frame: Callable[[int], FrameLabels]
