"""Furnished flat that is hard for SLAM: two rooms and a corridor with two identical ends.

World frame: x along the corridor, y across the corridor, z up; the origin is the center of the
corridor's floor.

A half turn about the z axis maps the architecture onto itself. It also maps the two ends of the
corridor onto each other, including their furniture. The two ends therefore look alike, which is
deliberate. The two rooms are furnished differently.

Frames are computed with + - * / and square roots of float64 alone, in a fixed order. They are
therefore bitwise equal on every machine.
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
