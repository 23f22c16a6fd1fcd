"""Synthetic scenes with exact poses and depth, the same bytes on every machine.

Rays are cast at solids, so depth is exact and views of the same point agree. Everything is built
from + - * / and square roots of float64 in a fixed order, which IEEE 754 rounds alike everywhere:
no sine, no logarithm, no matrix product.

    room, tour    one furnished room, rendered when read; -noisy: with a Kinect's depth
    person        the same room, and somebody walks through it; -noisy as above
    flat          two rooms and a corridor, hard on purpose and labelled; -exact: without noise

A number behind @ is the seed of textures, of the hand's shaking and of the noise: `room@3`.
"""

from ldo_service.errors import DataError
from ldo_service.synthetic import flat
from ldo_service.synthetic.flat import FlatConfig, FlatSequence

from . import room_sequence
from .room_sequence import SyntheticConfig, SyntheticSequence

__all__ = ["FlatConfig", "FlatSequence", "SyntheticConfig", "SyntheticSequence", "open_synthetic"]


def open_synthetic(name: str) -> SyntheticSequence | FlatSequence:
    """The sequence `synthetic:name`, or `synthetic:name@seed`.

    Raises DataError listing the known names, or when the seed is not a whole number.
    """
    plain, at, seed = name.partition("@")
    if at and not (seed.isascii() and seed.isdigit()):
        raise DataError(f"synthetic:{name}: behind @ stands a seed, such as synthetic:{plain}@3.")
    changes = {"seed": int(seed)} if at else {}
    if plain in room_sequence.NAMED:
        return SyntheticSequence.named(plain, **changes)
    if plain in flat.NAMED:
        return FlatSequence.named(plain, **changes)
    known = ", ".join(f"synthetic:{known}" for known in (*room_sequence.NAMED, *flat.NAMED))
    raise DataError(f"there is no synthetic:{plain}. There is {known}.")
