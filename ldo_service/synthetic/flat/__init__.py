"""Furnished flat that is hard for SLAM: two rooms and a corridor with two identical ends.

World frame: x along the corridor, y across it, z up; the origin is the center of its floor.

A half turn about the z axis maps the architecture onto itself. It also maps the two ends of the
corridor onto each other, furniture included: a deliberate perceptual aliasing. The two rooms are
furnished differently.

As in the single room, exact values use only + - * / and square roots of float64 in a fixed order.
Frames are therefore bitwise equal on every machine.
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
