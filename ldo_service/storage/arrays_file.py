"""Reader of NumPy .npz files from untrusted sources."""

import zipfile
import zlib
from math import prod
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error),
    *(MemoryError, OverflowError, NotImplementedError),  # Invalid sizes or compression in a header.
    *(RuntimeError, SyntaxError),  # Encrypted entries; headers that are no Python literal.
)


def read_arrays(path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """Read all arrays of a file by name, without unpickling.

    Args:
        path: The .npz file.
        max_bytes: Maximum total size of the arrays in bytes, checked before they are allocated.

    Raises:
        Exception: The file is damaged, too large or not readable; the type is one of UNREADABLE.
    """
    with zipfile.ZipFile(path) as archive:
        packed = sum(entry.file_size for entry in archive.infolist())
        announced = sum(_announced_bytes(archive, entry) for entry in archive.infolist())
    if max(packed, announced) > max_bytes:
        raise ValueError(
            f"the arrays have {max(packed, announced)} bytes, more than the maximum of {max_bytes}"
        )
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _announced_bytes(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Return the size in bytes that the header of an array declares.

    NumPy allocates this size without checking it.
    """
    with archive.open(entry) as file:
        if npy.read_magic(file) == (1, 0):
            shape, _, dtype = npy.read_array_header_1_0(file)
        else:
            shape, _, dtype = npy.read_array_header_2_0(file)
    return prod(shape) * dtype.itemsize
