"""Binary encoding of an actor's state: msgpack, with NumPy arrays as an extension type."""

from typing import Any

import msgspec
import numpy as np

ARRAY_CODE = 1  # MessagePack extension type of a NumPy array.
UNREADABLE = (
    *(ValueError, RecursionError),
    *(TypeError, SyntaxError, OverflowError, MemoryError),  # NumPy on an invalid dtype or shape.
)


def encode_state(value: object) -> bytes:
    """Encode plain values, bytes and NumPy arrays as MessagePack."""
    return msgspec.msgpack.encode(value, enc_hook=_array_to_ext)


def decode_state(body: bytes) -> Any:
    """Decode the result of `encode_state`.

    Raises:
        msgspec.DecodeError: The bytes cannot be decoded; no other exception occurs.
    """
    try:
        return msgspec.msgpack.decode(body, ext_hook=_array_from_ext)
    except UNREADABLE as error:
        raise msgspec.DecodeError(f"the encoded state cannot be decoded: {error}") from error


def _array_to_ext(value: object) -> msgspec.msgpack.Ext:
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray):
        raise NotImplementedError(
            f"an actor's state contains a {type(value).__name__}; it must contain plain values, "
            "bytes and NumPy arrays"
        )
    if value.dtype.hasobject:
        raise NotImplementedError(
            "an actor's state contains an array of Python objects; arrays must have a plain dtype"
        )
    # A view, because a copy of the largest arrays takes 10 ms.
    raw = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
    packed = (value.dtype.str, value.shape, raw)
    return msgspec.msgpack.Ext(ARRAY_CODE, msgspec.msgpack.encode(packed))


def _array_from_ext(code: int, data: memoryview) -> Any:
    if code != ARRAY_CODE:
        raise ValueError(f"MessagePack extension type {code} must be {ARRAY_CODE}, a NumPy array")
    dtype, shape, raw = msgspec.msgpack.decode(data, type=tuple[str, tuple[int, ...], bytes])
    array = np.frombuffer(raw, dtype).reshape(shape).copy()
    return array if shape else array[()]
