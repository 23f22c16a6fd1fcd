"""Local folders of running processes, with a limit on the size of the recordings in them.

Each process has a folder `job-*` and holds a lock on the file `lock` in this folder. The kernel
releases the lock when the process ends, even by a crash. The next process that starts removes each
folder whose lock is released.
"""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ldo_service.errors import DataError

LOCK, SIZE = "lock", "size"
WAIT_S = 1.0  # Interval at which a process looks whether there is space for its recording.
GB = 10**9


@contextmanager
def staging_folder(root: Path, size_bytes: int, max_bytes: int) -> Iterator[Path]:
    """Yield an empty folder, and remove it at the end of the context.

    The function first waits until the new recording fits: the recordings of all processes, together
    with the new one, must not exceed the limit.

    Args:
        root: Parent of the folders of all processes of this machine.
        size_bytes: Size of the recording that will be copied into the folder; 0 for none.
        max_bytes: Maximum total size of the recordings of all processes.

    Raises:
        DataError: The recording alone exceeds the limit, or the folder cannot be created.
    """
    if size_bytes > max_bytes:
        raise DataError(
            f"the recording has {size_bytes / GB:.3g} GB, more than --max-staged-gb "
            f"{max_bytes / GB:g} allows. Raise --max-staged-gb if {root} has enough free space."
        )
    try:
        root.mkdir(parents=True, exist_ok=True)
        folder, lock = _admitted(root, size_bytes, max_bytes)
    except OSError as error:
        raise DataError(
            f"{root} cannot be written: {error.strerror}. Choose another folder with --staging."
        ) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def remove_abandoned(root: Path) -> None:
    """Remove the folders of processes that have ended without removing them."""
    try:
        with _gate(root):
            _staged_bytes(root)
    except OSError:  # The folder does not exist, or cannot be written.
        return


@contextmanager
def _gate(root: Path) -> Iterator[None]:
    """Hold the lock that a process needs to inspect the folders of all processes or to add one."""
    gate = os.open(root / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(gate, fcntl.LOCK_EX)
        yield
    finally:
        os.close(gate)


def _admitted(root: Path, size_bytes: int, max_bytes: int) -> tuple[Path, int]:
    """Wait until the limit allows the recording, then create and lock its folder.

    Returns:
        The folder, and the file descriptor that holds the lock.
    """
    while True:
        with _gate(root):
            if _staged_bytes(root) + size_bytes <= max_bytes or size_bytes == 0:
                folder = Path(tempfile.mkdtemp(prefix="job-", dir=root))
                lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
                fcntl.flock(lock, fcntl.LOCK_EX)
                (folder / SIZE).write_text(str(size_bytes))
                return folder, lock
        time.sleep(WAIT_S)


def _staged_bytes(root: Path) -> int:
    """Return the size of the recordings of live processes, and remove folders of ended ones."""
    total = 0
    for folder in root.glob("job-*"):
        try:
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:  # The process has just removed its folder, or belongs to another user.
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except BlockingIOError:
            total += _size(folder / SIZE)
        finally:
            os.close(lock)
    return total


def _size(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return 0
