"""A furnished flat, hard on purpose: two rooms and a corridor whose ends look alike.

World: x along the corridor, y across it, z up; the origin lies on the floor in its middle. Half a
turn about the z axis takes the architecture onto itself, and the corridor's ends with all that
stands there; the two rooms are furnished differently. As in the single room, everything exact is
built from + - * / and square roots of float64 in a fixed order: the same bytes on every machine.
"""

from .scene_object import CLASS_NAMES, COCO_COUNT, SceneObject
from .sequence import NAMED, FlatConfig, FlatSequence

__all__ = [
    "CLASS_NAMES",
    "COCO_COUNT",
    "NAMED",
    "FlatConfig",
    "FlatSequence",
    "SceneObject",
]
