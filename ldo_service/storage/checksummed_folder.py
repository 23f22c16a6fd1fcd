"""A folder of numbered files that are read whole or not at all.

A file begins with a checksum of the rest, and gets its name when all of it is written: a reader
sees what was meant or is told that it is damaged. Not synced to the disk, so a power cut may damage
the last ones.
"""

import errno
import logging
import shutil
import struct
import tempfile
import weakref
import zlib
from pathlib import Path

from ldo_service.errors import ConfigError, DataError

from .atomic_write import UNFINISHED, write_atomically

log = logging.getLogger(__name__)

_HEADER = struct.Struct("<4sI")  # magic, CRC-32 of the rest
_MAGIC = b"LDO1"
_OF_PROCESS = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # limits that say nothing of a file


class ChecksummedFolder:
    """Files `<number>.<suffix>` in `folder`, which is made; others there are left alone.

    folder       None: a temporary one, which goes with this object
    consequence  what a full disk means, for the log

    Raises ConfigError for a folder that cannot be used.
    """

    def __init__(self, folder: Path | None, suffix: str, consequence: str) -> None:
        self.is_temporary = folder is None
        self._folder = folder or _temporary_folder(self, suffix)
        self._suffix, self._consequence = suffix, consequence
        self._is_refusing = False
        self.not_written = 0
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for unfinished in self._folder.glob(f"*.{suffix}{UNFINISHED}"):
                unfinished.unlink()
            self._sizes = self._found()
        except OSError as error:
            raise ConfigError(
                f"{self._folder} cannot be used: {error}. Choose a folder that can be written."
            ) from error

    @property
    def sizes(self) -> dict[int, int]:
        """Bytes of each file by number; not to be changed."""
        return self._sizes

    def write(self, number: int, body: bytes) -> bool:
        """Write or replace a file. False when the disk does not take it, which is counted, and
        logged once until it takes one again."""
        try:
            header = _HEADER.pack(_MAGIC, zlib.crc32(body))
            self._sizes[number] = write_atomically(self._path(number), header, body)
        except OSError as error:
            self.not_written += 1
            if not self._is_refusing:
                log.error("%s takes no files: %s. %s", self._folder, error, self._consequence)
            self._is_refusing = True
            return False
        self._is_refusing = False
        return True

    def read(self, number: int) -> memoryview:
        """What was written. Raises DataError for a file that is not what was written, and OSError
        where this process can open no more."""
        path = self._path(number)
        try:
            data = memoryview(path.read_bytes())
        except OSError as error:
            if error.errno in _OF_PROCESS:
                raise
            raise DataError(f"{path} cannot be read: {error}") from error
        body = data[_HEADER.size :]
        if bytes(data[: _HEADER.size]) != _HEADER.pack(_MAGIC, zlib.crc32(body)):
            raise DataError(f"{path} is damaged: {len(data)} bytes do not match their checksum")
        return body

    def remove(self, number: int) -> None:
        """A file that cannot be removed costs disk space only."""
        self._sizes.pop(number, None)
        try:
            self._path(number).unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s cannot be removed: %s", self._path(number), error)

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:08d}.{self._suffix}"

    def _found(self) -> dict[int, int]:
        files = self._folder.glob(f"*.{self._suffix}")
        return {int(file.stem): file.stat().st_size for file in files if file.stem.isdecimal()}


def _temporary_folder(owner: object, name: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix=f"ldo-{name}-"))
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    return folder
