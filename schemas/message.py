"""The base of every message, and the checks that msgspec does not make.

msgspec checks types while it decodes; it lets NaN pass and does not know that a buffer has to fit
its shape. Those checks run in `__post_init__`, so a message that exists is a valid one, whether it
was built or received. A failed check is a ValueError when built and a msgspec.ValidationError
when decoded.
"""

from collections.abc import Iterable
from math import isfinite
from typing import TypeVar

import msgspec

LAST_INTEGER = 2**63 - 1  # what an int64 holds: most languages and array dtypes have no more


class Message(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """stamp_ns: time of the sensor data it speaks of, the only clock that a handler sees."""

    stamp_ns: int  # since the epoch of the camera's clock

    def __post_init__(self) -> None:
        require_count("stamp_ns", self.stamp_ns)
        self.check()

    def check(self) -> None:
        """Raise ValueError when a field is impossible or fields contradict each other."""


T = TypeVar("T")


def decode(body: bytes | memoryview, kind: type[T]) -> T:
    """The message in a MessagePack body. Raises msgspec.DecodeError, whatever the bytes are."""
    try:
        return msgspec.msgpack.decode(body, type=kind)
    except msgspec.DecodeError:
        raise
    except (RecursionError, ValueError) as error:  # nested too deeply; text that is not UTF-8
        raise msgspec.DecodeError(f"cannot be decoded: {error}") from None


def encode(message: Message) -> bytes:
    """The MessagePack body of a message."""
    return msgspec.msgpack.encode(message)


def require_finite(name: str, numbers: Iterable[float]) -> None:
    values = tuple(numbers)
    if not all(isfinite(value) for value in values):
        raise ValueError(f"{name} holds NaN or infinity: {values[:8]}")


def require_count(name: str, value: int) -> None:
    """Identifiers, versions and counters are never negative, and fit an int64."""
    if not 0 <= value <= LAST_INTEGER:
        raise ValueError(f"{name} is {value}, must be in 0 .. 2^63 - 1")
