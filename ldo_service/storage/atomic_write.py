"""Files and folders that appear whole or not at all.

The content is first written to a temporary file or folder next to the target. A rename then
replaces the target, so a reader sees the whole old content or the whole new content. A failed write
removes the temporary file or folder; a killed process may leave it. The name of a temporary file
ends in `.new`, and the name of a temporary folder begins with `.new-`.
"""

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

UNFINISHED = ".new"  # Suffix of a file that is being written.


def write_atomically(path: Path, *parts: bytes, syncs: bool = False, unique: bool = False) -> int:
    """Write or replace a file.

    Args:
        path: The file; its folder must exist.
        parts: The content, concatenated in order.
        syncs: Wait until content and file name are on the disk, so that a power cut loses nothing.
        unique: Use a temporary name that no other process uses. This is needed if several processes
            may write the file at the same time.

    Returns:
        The size of the file in bytes.

    Raises:
        OSError: The file cannot be written; the old content is unchanged.
    """
    unfinished = path.with_name(path.name + UNFINISHED)
    if unique:
        number, name = tempfile.mkstemp(UNFINISHED, path.name, path.parent)
        os.close(number)
        unfinished = Path(name)
    try:
        size = unfinished.write_bytes(b"".join(parts))
        if syncs:
            sync(unfinished)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    if syncs:
        sync(path.parent)
    return size


@contextmanager
def folder_made_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a folder, and rename this folder to `path` after the block.

    The block must create the folder at the temporary path.

    Raises:
        OSError: The folder cannot be created; no part of it remains.
    """
    with tempfile.TemporaryDirectory(prefix=f"{UNFINISHED}-", dir=path.parent) as temporary:
        made = Path(temporary) / path.name
        yield made
        made.rename(path)


def make_folder(path: Path) -> None:
    """Create a folder and its parents, and wait until their names are on the disk.

    Raises:
        OSError: The folder cannot be created.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        sync(folder.parent)


def sync_all(paths: Iterable[Path]) -> None:
    """Sync files and folders to the disk, and skip paths that do not exist any more."""
    for path in paths:
        with suppress(FileNotFoundError):
            sync(path)


def with_folders(files: Iterable[Path]) -> list[Path]:
    """Return files and then their folders, because the folder of a new file must be synced too."""
    files = list(files)
    return [*files, *dict.fromkeys(file.parent for file in files)]


def sync(path: Path) -> None:
    """Wait until the content of a file, or the list of file names of a folder, is on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
