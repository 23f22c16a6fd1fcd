"""Arrays of a file in NumPy's .npz, which a stranger may have made."""

import zipfile
import zlib
from math import prod
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error),
    *(MemoryError, OverflowError, NotImplementedError),  # sizes and methods that a header makes up
    *(RuntimeError, SyntaxError),  # it says that it is encrypted; its header is no literal
)


def read_arrays(path: Path, largest_bytes: int) -> dict[str, np.ndarray]:
    """All arrays by name. Nothing is unpickled, and no memory is taken for what says it is larger.

    Raises one of UNREADABLE.
    """
    with zipfile.ZipFile(path) as archive:
        packed = sum(entry.file_size for entry in archive.infolist())
        announced = sum(_announced_bytes(archive, entry) for entry in archive.infolist())
    if max(packed, announced) > largest_bytes:
        raise ValueError(f"it unpacks to {max(packed, announced)} bytes, over {largest_bytes}")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _announced_bytes(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """What the array's header says, which NumPy takes at its word."""
    with archive.open(entry) as file:
        if npy.read_magic(file) == (1, 0):
            shape, _, dtype = npy.read_array_header_1_0(file)
        else:
            shape, _, dtype = npy.read_array_header_2_0(file)
    return prod(shape) * dtype.itemsize
