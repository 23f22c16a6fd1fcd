"""Folder of numbered files with checksums.

A file begins with a checksum of its content, and gets its final name when it is completely written.
A reader gets exactly the written content or an error. Files are not synced to the disk when they
are written, so a power cut may damage them until the caller has synced `unsynced_files`.
"""

import errno
import logging
import struct
import weakref
import zlib
from pathlib import Path

from ldo_service.errors import ConfigError, DataError

from .atomic_write import UNFINISHED, make_folder, write_atomically
from .temporary_folder import make_temporary_folder, remove_temporary_folder

log = logging.getLogger(__name__)

_HEADER = struct.Struct("<4sI")  # Magic, CRC-32 of the content.
_MAGIC = b"LDO1"
_OF_PROCESS = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # Limits of the process, not of a file.


class ChecksummedFolder:
    """Files `<number>.<suffix>` in a folder; other files in the folder stay unchanged.

    Attributes:
        is_temporary: Whether the folder is deleted with this object.
        not_written: Number of failed writes.
    """

    def __init__(self, folder: Path | None, suffix: str, consequence: str) -> None:
        """Create or open the folder.

        Args:
            folder: The folder; None for a temporary folder, which is deleted with this object.
            suffix: Suffix of the files.
            consequence: Sentence about the consequence of a failed write, for the log message.

        Raises:
            ConfigError: The folder cannot be used.
        """
        self.is_temporary = folder is None
        self._folder = folder or _temporary_folder(self)
        self._suffix, self._consequence = suffix, consequence
        self._is_refusing = False
        self.not_written = 0
        try:
            make_folder(self._folder)
            for unfinished in self._folder.glob(f"*.{suffix}{UNFINISHED}"):
                unfinished.unlink()
            self._sizes = self._found()
            self._unsynced: set[int] = set()  # Written after the last `begin_sync`.
            self._syncing: set[int] = set()  # Written between `begin_sync` and `end_sync`.
        except OSError as error:
            raise ConfigError(
                f"{self._folder} cannot be used: {error}. Choose a folder that is writable."
            ) from error

    @property
    def sizes(self) -> dict[int, int]:
        """Size of each file in bytes, by number; read-only."""
        return self._sizes

    def write(self, number: int, body: bytes) -> bool:
        """Write or replace a file.

        Returns:
            False if the write failed. Failures are counted. Of consecutive failures, only the
            first is logged.
        """
        try:
            header = _HEADER.pack(_MAGIC, zlib.crc32(body))
            self._sizes[number] = write_atomically(self._path(number), header, body)
            self._unsynced.add(number)
        except OSError as error:
            self.not_written += 1
            if not self._is_refusing:
                log.error(
                    "%s: writing a file failed: %s. %s", self._folder, error, self._consequence
                )
            self._is_refusing = True
            return False
        self._is_refusing = False
        return True

    def read(self, number: int) -> memoryview:
        """Read the content of a file.

        Raises:
            DataError: The file is missing or damaged.
            OSError: This process has reached a limit of memory or open files.
        """
        return read_checked(self._path(number))

    def remove(self, number: int) -> None:
        """Remove a file; if the removal fails, log the failure and leave the file on the disk."""
        self._sizes.pop(number, None)
        self._unsynced.discard(number)
        self._syncing.discard(number)
        try:
            self._path(number).unlink(missing_ok=True)
        except OSError as error:
            log.warning(
                "%s cannot be removed: %s. It only takes disk space; no action needed.",
                self._path(number), error,
            )  # fmt: skip

    def unsynced_files(self) -> list[Path]:
        """Return the files that this object wrote and that may not be on the disk yet."""
        return [self._path(number) for number in sorted(self._unsynced | self._syncing)]

    def begin_sync(self) -> None:
        """Record that the caller now syncs the files that `unsynced_files` returned last."""
        self._syncing |= self._unsynced
        self._unsynced.clear()

    def end_sync(self) -> None:
        """Record that the files of the last `begin_sync` are on the disk."""
        self._syncing.clear()

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:08d}.{self._suffix}"

    def _found(self) -> dict[int, int]:
        files = self._folder.glob(f"*.{self._suffix}")
        return {int(file.stem): file.stat().st_size for file in files if file.stem.isdecimal()}


def read_checked(path: Path) -> memoryview:
    """Read the content of a file of a `ChecksummedFolder`.

    Raises:
        DataError: The file is missing or damaged.
        OSError: This process has reached a limit of memory or open files.
    """
    try:
        data = memoryview(path.read_bytes())
    except OSError as error:
        if error.errno in _OF_PROCESS:
            raise
        raise DataError(f"{path} cannot be read: {error}") from error
    body = data[_HEADER.size :]
    if bytes(data[: _HEADER.size]) != _HEADER.pack(_MAGIC, zlib.crc32(body)):
        raise DataError(f"{path} is damaged: its {len(data)} bytes do not match their checksum")
    return body


def _temporary_folder(owner: object) -> Path:
    folder, lock = make_temporary_folder()
    weakref.finalize(owner, remove_temporary_folder, folder, lock)
    return folder
