"""Synthetic RGB-D sequences with exact poses and depth, bitwise equal on every machine.

A ray caster renders scenes of simple solids, so depth is exact and consistent between views.
Poses, colors and exact depth are computed with + - * / and square roots of float64 alone, in a
fixed order. IEEE 754 rounds these operations identically everywhere; sines, logarithms and matrix
products differ between machines.

Sequences:

- `room`, `tour`: One furnished room. The sequence `tour` is longer and shows all four walls.
- `person`: The same room, with a person who walks through it.
- `room-noisy`, `tour-noisy`, `person-noisy`: The sequences above with the depth errors of a Kinect.
- `flat`: Two rooms and a corridor with ground-truth labels, designed to be hard for SLAM.
- `twins`: Four offices along a corridor that look alike and differ only in their objects.
- `corridor`: A walk to the end of a long corridor and back, with weak texture, identical doors and
  few objects.
- `flat-exact`, `twins-exact`, `corridor-exact`: The same scenes without motion blur, noise and
  other sensor errors.
- `room-handheld`, `tour-handheld`, `person-handheld`, `flat-handheld`: Faster motion, with
  simulated effects of real cameras such as motion blur. All effects are on by default. Names after
  a colon, joined by `+`, select single effects: `tour-handheld:rolling-shutter+stereo`.

A number after @, as in `room@3`, is the seed of textures, hand shake and noise. The default is 0.
"""

from ldo_service.errors import DataError
from ldo_service.synthetic import flat
from ldo_service.synthetic.flat import FlatConfig, FlatSequence

from . import handheld, room_sequence
from .handheld import HandheldConfig, HandheldSequence
from .room_sequence import SyntheticConfig, SyntheticSequence

__all__ = [
    "SCENES",
    "FlatConfig",
    "FlatSequence",
    "HandheldConfig",
    "HandheldSequence",
    "SyntheticConfig",
    "SyntheticSequence",
    "open_synthetic",
]

SCENES = (*room_sequence.NAMED, *flat.NAMED, *handheld.NAMED)  # Names of all built-in scenes.


def open_synthetic(name: str) -> SyntheticSequence | FlatSequence | HandheldSequence:
    """Return a built-in sequence.

    Args:
        name: Name of the sequence without `synthetic:`, such as `room@3`. The module docstring
            lists the names.

    Raises:
        DataError: If the name is unknown (the message lists the known names) or the seed is not
            a whole number.
    """
    plain, at, seed = name.partition("@")
    if at and not (seed.isascii() and seed.isdigit()):
        raise DataError(
            f"synthetic:{name}: the seed after @ must be a whole number, as in synthetic:{plain}@3."
        )
    changes = {"seed": int(seed)} if at else {}
    if plain in room_sequence.NAMED:
        return SyntheticSequence.named(plain, **changes)
    if plain in flat.NAMED:
        return FlatSequence.named(plain, **changes)
    if handheld.MARK in plain:
        return HandheldSequence.named(plain, **changes)
    known = ", ".join(f"synthetic:{known}" for known in SCENES)
    raise DataError(f"unknown sequence synthetic:{plain}. Choose one of {known}.")
