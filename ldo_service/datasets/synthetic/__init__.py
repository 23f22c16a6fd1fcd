"""A furnished room with exact poses and depth, the same bytes on every machine.

Rays are cast at solids, so depth is exact and views of the same point agree. Everything is built
from + - * / and square roots of float64 in a fixed order, which IEEE 754 rounds alike everywhere:
no sine, no logarithm, no matrix product.
"""

from .sequence import SyntheticConfig, SyntheticSequence

__all__ = ["SyntheticConfig", "SyntheticSequence"]
