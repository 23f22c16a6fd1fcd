"""NumPy array as a field of messages: bytes, shape and dtype."""

from math import prod
from typing import Literal, cast, get_args

import msgspec
import numpy as np

# Type of the numbers of an array: unsigned, signed or float, and bytes per number.
DType = Literal["u1", "u2", "u4", "i4", "i8", "f4", "f8"]
DTYPES = get_args(DType)
MAX_DIMENSIONS = 8
MAX_LENGTH = 1 << 32  # Maximum length of a dimension; it also limits the shape of empty arrays.


class Array(msgspec.Struct, frozen=True):
    """Little-endian array in C order.

    `np.frombuffer(data, dtype).reshape(shape)` converts the fields into a NumPy array.
    """

    dtype: DType
    shape: tuple[int, ...]
    data: memoryview

    def __post_init__(self) -> None:
        if len(self.shape) > MAX_DIMENSIONS or any(not 0 <= n < MAX_LENGTH for n in self.shape):
            raise ValueError(
                f"array shape {self.shape[:8]} is impossible: it must have at most "
                f"{MAX_DIMENSIONS} dimensions, each from 0 to 2^32 - 1"
            )
        expected = prod(self.shape) * int(self.dtype[1])
        if self.data.nbytes != expected:
            raise ValueError(
                f"array {self.dtype}{list(self.shape)} needs {expected} bytes, "
                f"has {self.data.nbytes}"
            )

    @classmethod
    def of(cls, values: np.ndarray) -> "Array":
        """Return an array with a copy of `values`.

        Later changes of `values` do not affect the returned array.

        Raises:
            ValueError: If the dtype is not one of `DTYPES`.
        """
        dtype = values.dtype.str[1:]
        if dtype not in DTYPES:
            raise ValueError(f"arrays of {values.dtype} are not supported; use one of {DTYPES}")
        little = values.astype("<" + dtype, copy=False)
        return cls(cast(DType, dtype), values.shape, memoryview(little.tobytes()))

    def numpy(self) -> np.ndarray:
        """Return the array as a read-only NumPy view, without a copy.

        The memory of the view may be unaligned if the array was decoded from a received message.
        """
        view = np.frombuffer(self.data, "<" + self.dtype).reshape(self.shape)
        view.flags.writeable = False
        return view

    def require(self, name: str, dtype: DType, shape: tuple[int | None, ...]) -> None:
        """Check dtype and shape of the array.

        Args:
            name: Name of the array in the error message.
            dtype: Required dtype.
            shape: Required shape; None for a dimension of any length.

        Raises:
            ValueError: If dtype or shape differ.
        """
        fits = len(shape) == len(self.shape) and all(
            want is None or want == have for want, have in zip(shape, self.shape, strict=True)
        )
        if self.dtype != dtype or not fits:
            want = ["any" if n is None else n for n in shape]
            raise ValueError(f"{name} is {self.dtype}{list(self.shape)}, must be {dtype}{want}")

    def require_finite(self, name: str) -> None:
        """Raise ValueError if the array holds NaN or infinity."""
        if not np.isfinite(self.numpy()).all():
            raise ValueError(f"{name} holds NaN or infinity")

    def require_ascending(self, name: str) -> None:
        """Raise ValueError unless the array [N] holds ids of at least 0 in ascending order."""
        ids = self.numpy()
        if (ids.size and ids[0] < 0) or (ids[1:] <= ids[:-1]).any():
            raise ValueError(f"{name} must hold ascending ids of at least 0")
