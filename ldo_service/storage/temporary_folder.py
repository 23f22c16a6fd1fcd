"""Temporary folders that are removed even if their process is killed.

A process that is killed cannot remove its temporary folders. Each folder is therefore locked while
it is in use, and the operating system releases the lock when the process ends. Whenever a process
makes such a folder, it first removes the folders that no process has locked any more. The lock also
keeps systemd-tmpfiles from removing the files of a service that runs for many days.
"""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# Prefix of the folders in the temporary folder; other folders there must not have it.
PREFIX = "ldo-tmp-"


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a new folder that only this user can read, and remove it after the block.

    Raises:
        OSError: The folder cannot be created.
    """
    path, lock = make_temporary_folder()
    try:
        yield path
    finally:
        remove_temporary_folder(path, lock)


def make_temporary_folder() -> tuple[Path, int]:
    """Create a folder that only this user can read.

    Returns:
        The path, and the descriptor that holds the lock; see `remove_temporary_folder`.

    Raises:
        OSError: The folder cannot be created.
    """
    _remove_unused()
    while True:
        path = Path(tempfile.mkdtemp(prefix=PREFIX))
        with suppress(FileNotFoundError):  # Another process removed it before it was locked.
            lock = _open(path)
            with suppress(OSError):  # A network file system may not lock folders.
                fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists():
                return path, lock
            os.close(lock)


def remove_temporary_folder(path: Path, lock: int) -> None:
    """Remove a folder with its files, and release its lock."""
    shutil.rmtree(path, ignore_errors=True)
    os.close(lock)


def _open(path: Path) -> int:
    """Open a folder, but no symbolic link, which another user may have made."""
    return os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _remove_unused() -> None:
    """Remove the folders of this user that no process has locked."""
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # The folder belongs to another user, or is in use.
            lock = _open(path)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_uid == os.geteuid():
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)
