"""Files that are read whole or not at all.

A file begins with a checksum of the rest, and gets its name when all of it is written: a reader
sees what was meant or is told that it is damaged. Not synced to the disk, so a power cut may damage
the last ones.
"""

import struct
import zlib
from pathlib import Path

from ldo_service.errors import DataError

_HEADER = struct.Struct("<4sI")  # magic, CRC-32 of the rest
_MAGIC = b"LDO1"
UNFINISHED = ".new"  # added to the name while a file is written


def write_sealed(path: Path, body: bytes) -> int:
    """Write or replace a file; its size in bytes. Raises OSError, and then leaves nothing new."""
    unfinished = path.with_name(path.name + UNFINISHED)
    try:
        with unfinished.open("wb") as file:
            file.write(_HEADER.pack(_MAGIC, zlib.crc32(body)))
            file.write(body)
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    return _HEADER.size + len(body)


def read_sealed(path: Path) -> memoryview:
    """What was written. Raises OSError, and DataError for a file that is not what was written."""
    data = memoryview(path.read_bytes())
    body = data[_HEADER.size :]
    if bytes(data[: _HEADER.size]) != _HEADER.pack(_MAGIC, zlib.crc32(body)):
        raise DataError(f"{path} is damaged: its {len(data)} bytes do not match their checksum.")
    return body
