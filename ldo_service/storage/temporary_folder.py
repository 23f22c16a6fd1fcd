"""Temporary folders that are removed even if their process is killed.

A process that is killed cannot remove its temporary folders. Each folder is therefore locked while
it is in use, and the operating system releases the lock when the process ends. Whenever a process
makes such a folder, it first removes the folders that no process has locked any more. The lock also
keeps systemd-tmpfiles from removing the files of a service that runs for many days.

Several machines may share the folder of temporary files over a network, where one machine may not
see the locks of another. The name of a folder therefore contains a number for its machine, and a
process removes only folders of its own machine. It also removes nothing on a file system that
ignores locks.
"""

import fcntl
import hashlib
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# Prefix of the folders in the temporary folder; other folders there must not have it.
PREFIX = "ldo-tmp-"
# File with a random number that differs between machines. Containers may have the same one, but
# have different host names.
MACHINE_ID = Path("/etc/machine-id")


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
    prefix = PREFIX + _machine() + "-"
    _remove_unused(prefix)
    while True:
        path = Path(tempfile.mkdtemp(prefix=prefix))
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


def _machine() -> str:
    """Return eight hexadecimal digits for this machine, which stay the same after a reboot."""
    known = platform.node().encode()
    with suppress(OSError):
        known += MACHINE_ID.read_bytes()
    return hashlib.sha256(known).hexdigest()[:8]


def _remove_unused(prefix: str) -> None:
    """Remove the folders of this user and machine that no process has locked."""
    for path in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with suppress(OSError):  # The folder belongs to another user, or is in use.
            lock = _open(path)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_uid == os.geteuid() and _is_locked(path):
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)


def _is_locked(path: Path) -> bool:
    """Return whether a folder is locked; False for a locked folder if locks have no effect."""
    descriptor = _open(path)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
