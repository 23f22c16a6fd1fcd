"""The base of every message, and the checks that msgspec does not make.

msgspec checks types while it decodes; it lets NaN pass and does not know that a buffer has to fit
its shape. Those checks run in `__post_init__`, so a message that exists is a valid one, whether it
was built or received. A failed check is a ValueError when built and a msgspec.ValidationError
when decoded.
"""

from collections.abc import Iterable
from math import isfinite

import msgspec

LAST_STAMP_NS = 2**63 - 1


class Message(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """stamp_ns: time of the sensor data it speaks of, the only clock that a handler sees."""

    stamp_ns: int  # since the epoch of the camera's clock

    def __post_init__(self) -> None:
        if not 0 <= self.stamp_ns <= LAST_STAMP_NS:
            raise ValueError(f"stamp_ns {self.stamp_ns} is outside 0 .. 2^63 - 1")
        self.check()

    def check(self) -> None:
        """Raise ValueError when a field is impossible or fields contradict each other."""


def require_finite(name: str, numbers: Iterable[float]) -> None:
    values = tuple(numbers)
    if not all(isfinite(value) for value in values):
        raise ValueError(f"{name} holds NaN or infinity: {values[:8]}")


def require_count(name: str, value: int) -> None:
    """Identifiers, versions and counters are never negative."""
    if value < 0:
        raise ValueError(f"{name} is {value}, must be at least 0")
