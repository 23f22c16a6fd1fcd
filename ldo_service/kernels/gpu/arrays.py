"""Arrays that kernels read and write: memory, sorting and sums, in NumPy or in torch.

`HostArrays` serves the interpreter of Triton and needs no torch. `TorchArrays` serves a GPU, and
runs on a CPU too. Both give equal results, because they sort stably and add no floating-point
numbers.
"""

from importlib import import_module
from typing import Any, Protocol

import numpy as np

from ldo_service.errors import ConfigError, install_command

MAX_PAIRS = 2**31 - 1  # The kernels count pairs of a Gaussian and a tile in int32.


class Arrays(Protocol):
    """Operations on arrays of one device. The type `Any` stands for an array on this device."""

    def upload(self, values: np.ndarray) -> Any:
        """Return a copy of host values on the device."""

    def download(self, array: Any) -> np.ndarray:
        """Return a copy of an array on the host."""
        ...

    def empty(self, shape: tuple[int, ...], dtype: type) -> Any:
        """Return an uninitialized array; a kernel must write it before anything reads it."""

    def zeros(self, shape: tuple[int, ...], dtype: type) -> Any:
        """Return an array of zeros."""

    def nonzero(self, array: Any) -> Any:
        """Return the indices [V] int32 of the values that are not 0, ascending."""

    def stable_order(self, keys: Any) -> Any:
        """Return the indices [M] int32 that sort the keys; equal keys keep their order."""

    def take(self, array: Any, places: Any) -> Any:
        """Return the rows of an array at the indices `places`."""

    def put(self, array: Any, places: Any, values: Any) -> None:
        """Replace the rows of an array at the indices `places`, in place."""

    def offsets(self, counts: Any) -> tuple[Any, int]:
        """Return the exclusive prefix sums [M] int32 of the counts, and the sum of all counts.

        Raises:
            ConfigError: The sum of all counts does not fit into int32.
        """
        ...

    def repeat(self, values: Any, counts: Any, total: int) -> Any:
        """Repeat each value as often as its count says; `total` is the sum of the counts."""

    def starts(self, ascending: Any, n: int) -> Any:
        """Return, for each k in 0..n, the index of the first value >= k in an ascending array.

        The result is an array [n + 1] int32.
        """

    def peak_bytes(self) -> int:
        """Return the peak GPU memory of the arrays so far, in bytes."""
        ...


def checked_total(total: int) -> int:
    """Return `total`, the number of pairs of a Gaussian and a tile, if it fits into int32.

    Raises:
        ConfigError: `total` does not fit into int32.
    """
    if total > MAX_PAIRS:
        raise ConfigError(
            f"the rendering has {total} pairs of a Gaussian and a tile, at most {MAX_PAIRS} are "
            "possible. Use smaller images, or reduce mapper.offload.max_resident_gaussians."
        )
    return total


class HostArray:
    """NumPy array with the methods of a tensor that the interpreter of Triton calls.

    The interpreter copies the memory of a tensor to the host before a launch and back after it.
    Tensors of this class are in host memory already, so the copy is the tensor itself.
    """

    def __init__(self, values: np.ndarray) -> None:
        self.values = np.ascontiguousarray(values)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def dtype(self) -> np.dtype:
        return self.values.dtype

    def data_ptr(self) -> int:
        return self.values.ctypes.data

    def untyped_storage(self) -> "HostArray":
        return self

    def cpu(self) -> "HostArray":
        return self

    def copy_(self, other: "HostArray") -> None:
        assert other.values is self.values

    def storage_offset(self) -> int:
        return 0

    def size(self) -> tuple[int, ...]:
        return self.values.shape

    def stride(self) -> tuple[int, ...]:
        return tuple(step // self.values.itemsize for step in self.values.strides)

    def new_empty(self, *_: object, **__: object) -> "HostArray":
        return HostArray(np.empty(0, self.values.dtype))

    def set_(self, storage: "HostArray", *_: object) -> None:
        self.values = storage.values


class HostArrays:
    """Arrays in NumPy, for kernels in the interpreter of Triton."""

    def upload(self, values: np.ndarray) -> HostArray:
        return HostArray(np.array(values))

    def download(self, array: HostArray) -> np.ndarray:
        return array.values.copy()

    def empty(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        return HostArray(np.empty(shape, dtype))

    def zeros(self, shape: tuple[int, ...], dtype: type) -> HostArray:
        return HostArray(np.zeros(shape, dtype))

    def nonzero(self, array: HostArray) -> HostArray:
        return HostArray(np.flatnonzero(array.values).astype(np.int32))

    def stable_order(self, keys: HostArray) -> HostArray:
        return HostArray(np.argsort(keys.values, kind="stable").astype(np.int32))

    def take(self, array: HostArray, places: HostArray) -> HostArray:
        return HostArray(array.values[places.values])

    def put(self, array: HostArray, places: HostArray, values: HostArray) -> None:
        array.values[places.values] = values.values

    def offsets(self, counts: HostArray) -> tuple[HostArray, int]:
        sums = np.cumsum(counts.values, dtype=np.int64)
        total = checked_total(int(sums[-1]) if len(sums) else 0)
        return HostArray((sums - counts.values).astype(np.int32)), total

    def repeat(self, values: HostArray, counts: HostArray, total: int) -> HostArray:
        out = np.repeat(values.values, counts.values)
        assert len(out) == total
        return HostArray(out)

    def starts(self, ascending: HostArray, n: int) -> HostArray:
        return HostArray(np.searchsorted(ascending.values, np.arange(n + 1)).astype(np.int32))

    def peak_bytes(self) -> int:
        return 0


class TorchArrays:
    """Arrays in torch, on a GPU or on a CPU.

    Args:
        device: Name of the device in torch, such as `cuda`.

    Raises:
        ConfigError: torch is not installed.
    """

    def __init__(self, device: str) -> None:
        try:
            torch = import_module("torch")  # The library is optional.
        except ImportError as error:
            raise ConfigError(
                f"arrays on the device {device} need torch. Run {install_command('cuda')}."
            ) from error
        self._torch, self._device = torch, device

    def upload(self, values: np.ndarray) -> Any:
        return self._torch.tensor(values, device=self._device)

    def download(self, array: Any) -> np.ndarray:
        return np.array(array.cpu().numpy())

    def empty(self, shape: tuple[int, ...], dtype: type) -> Any:
        return self._torch.empty(shape, dtype=self._dtype(dtype), device=self._device)

    def zeros(self, shape: tuple[int, ...], dtype: type) -> Any:
        return self._torch.zeros(shape, dtype=self._dtype(dtype), device=self._device)

    def nonzero(self, array: Any) -> Any:
        return self._torch.nonzero(array).reshape(-1).to(self._torch.int32)

    def stable_order(self, keys: Any) -> Any:
        return self._torch.sort(keys, stable=True).indices.to(self._torch.int32)

    def take(self, array: Any, places: Any) -> Any:
        return array[places.long()]

    def put(self, array: Any, places: Any, values: Any) -> None:
        array[places.long()] = values

    def offsets(self, counts: Any) -> tuple[Any, int]:
        sums = self._torch.cumsum(counts, 0)  # The result is int64.
        total = checked_total(int(sums[-1]) if len(sums) else 0)
        return (sums - counts).to(self._torch.int32), total

    def repeat(self, values: Any, counts: Any, total: int) -> Any:
        return self._torch.repeat_interleave(values, counts, output_size=total)

    def starts(self, ascending: Any, n: int) -> Any:
        edges = self._torch.arange(n + 1, dtype=ascending.dtype, device=self._device)
        return self._torch.searchsorted(ascending, edges, out_int32=True)

    def peak_bytes(self) -> int:
        return int(self._torch.cuda.max_memory_allocated())

    def _dtype(self, dtype: type) -> Any:
        return getattr(self._torch, np.dtype(dtype).name)
