"""Synthetic scenes with exact poses and depth, the same bytes on every machine.

Rays are cast at solids, so depth is exact and views of the same point agree. Everything is built
from + - * / and square roots of float64 in a fixed order, which IEEE 754 rounds alike everywhere:
no sine, no logarithm, no matrix product.

    room, tour    one furnished room, rendered when read; -noisy: with a Kinect's depth
    person        the same room, and somebody walks through it; -noisy as above
    flat          two rooms and a corridor, hard on purpose and labelled; -exact: without noise
"""

from ldo_service.errors import DataError

from . import flat, sequence
from .flat import FlatConfig, FlatSequence
from .sequence import SyntheticConfig, SyntheticSequence

__all__ = ["FlatConfig", "FlatSequence", "SyntheticConfig", "SyntheticSequence", "open_synthetic"]


def open_synthetic(name: str) -> SyntheticSequence | FlatSequence:
    """The sequence `synthetic:name`. Raises DataError listing the known names."""
    if name in sequence.NAMED:
        return SyntheticSequence.named(name)
    if name in flat.NAMED:
        return FlatSequence.named(name)
    known = ", ".join(f"synthetic:{known}" for known in (*sequence.NAMED, *flat.NAMED))
    raise DataError(f"there is no synthetic:{name}. There is {known}.")
