"""Base class of every message, and the checks that msgspec does not make.

msgspec checks types while it decodes. It accepts NaN, however, and does not check that the data of
an array have the size that its shape requires. The checks of this package run in `__post_init__`,
so every message object is valid, whether it was built or received. A failed check raises ValueError
when a message is built, and msgspec.ValidationError when a message is decoded.
"""

from collections.abc import Iterable
from math import isfinite
from typing import TypeVar

import msgspec

LAST_INTEGER = 2**63 - 1  # Largest int64: most languages and array dtypes have no larger integer.


class Message(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """Base class of all messages.

    stamp_ns is the time of the sensor data that the message refers to. Actors use no other time in
    their computations, so that a replay gives the same results as the recorded run.
    """

    stamp_ns: int  # Nanoseconds since the epoch of the camera's clock.

    def __post_init__(self) -> None:
        require_count("stamp_ns", self.stamp_ns)
        self.check()

    def check(self) -> None:
        """Raise ValueError if a field has an invalid value or fields contradict each other."""


T = TypeVar("T")


def decode(body: bytes | memoryview, kind: type[T]) -> T:
    """Return the message in a MessagePack body.

    Raises:
        msgspec.DecodeError: If the bytes are no valid message of this type.
    """
    try:
        return msgspec.msgpack.decode(body, type=kind)
    except msgspec.DecodeError:
        raise
    except (RecursionError, ValueError) as error:  # Nested too deeply, or text that is not UTF-8.
        raise msgspec.DecodeError(f"the message cannot be decoded: {error}") from None


def encode(message: Message) -> bytes:
    """Return the MessagePack body of a message."""
    return msgspec.msgpack.encode(message)


def require_finite(name: str, numbers: Iterable[float]) -> None:
    """Raise ValueError if a number is NaN or infinite."""
    values = tuple(numbers)
    if not all(isfinite(value) for value in values):
        raise ValueError(f"{name} holds NaN or infinity: {values[:8]}")


def require_count(name: str, value: int) -> None:
    """Raise ValueError unless an id, version or counter is at least 0 and fits in an int64."""
    if not 0 <= value <= LAST_INTEGER:
        raise ValueError(f"{name} is {value}, must be in 0 .. 2^63 - 1")
