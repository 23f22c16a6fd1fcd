"""Simulated disk: files in memory, a log of all changes, and its faults.

The code under test gets a `DiskPath` where it expects a `Path`. A power cut leaves the disk in a
state that `tests.faults.disk_log.crash_state` draws from the log of changes.
"""

import errno
import os
import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from tests.faults.disk_log import Change, DiskLog, crash_state

from .disk_path import DiskPath, error_of
from .virtual_loop import CURRENT

ROOT = "/simulated"
FIRST_DESCRIPTOR = 1 << 30  # File descriptors of the simulated disk; the kernel gives small ones.


class SimulatedDisk:
    """Files and folders below `ROOT`.

    Attributes:
        is_full: Whether writes fail with ENOSPC.
        error_probability: Probability that a change or a sync fails with EIO.
        operations: Number of operations so far.
    """

    def __init__(self, seed: int) -> None:
        """Create an empty disk.

        Args:
            seed: Seed of errors and of the changes that a power cut loses.
        """
        self.rng = random.Random(f"{seed} disk")
        self.is_full, self.error_probability, self.operations = False, 0.0, 0
        self._folders: dict[str, dict[str, _File]] = {"/": {}, ROOT: {}}
        self._log, self._inodes = DiskLog(root=None), 0  # type: ignore[arg-type]
        self._open: dict[int, tuple[str, _File | None]] = {}
        self._descriptor = FIRST_DESCRIPTOR
        self.path: Any = DiskPath(self, ROOT)

    # --- faults ---------------------------------------------------------------------------------
    def _count(self, *, changes: bool = False) -> None:
        """Count an operation of the current process, which may kill the process or fail.

        Raises:
            OSError: The disk has an error.
            KilledError: The process is dead.
        """
        self.operations += 1
        process = CURRENT.get()
        if process is not None:
            process.count_disk_operation()
        if changes and self.error_probability and self.rng.random() < self.error_probability:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def cut_power(self) -> None:
        """Lose changes that were not synced."""
        state = crash_state(self._log, len(self._log.changes), self.rng)
        self._folders, self._log = {"/": {}, ROOT: {}}, DiskLog(Path(ROOT))
        for name, data in state.files.items():
            path = f"{ROOT}/{name}"
            folder = path.rpartition("/")[0]
            for parent in (*PurePosixPath(folder).parents, PurePosixPath(folder)):
                if str(parent).startswith(ROOT) and str(parent) not in self._folders:
                    self._folders[str(parent)] = {}
                    self._note("folder", str(parent))
                    self._note("sync", str(parent.parent))
            self._create(path).data = data
            file = self._file(path)
            self._note("write", path, file, data)
            self._note("sync", path, file)
            self._note("sync", folder)

    def flip_bit(self) -> str:
        """Flip a bit of a random file of a saved state, and return the path of the file."""
        paths = [
            f"{folder}/{name}"
            for folder, files in sorted(self._folders.items())
            if f"{folder}/".startswith(f"{ROOT}/state/") and "." not in folder
            for name, file in sorted(files.items())
            if file.data
        ]
        if not paths:
            return ""
        path = self.rng.choice(paths)
        file, number = self._file(path), self.rng.randrange(8 * len(self._file(path).data))
        damaged = bytearray(file.data)
        damaged[number // 8] ^= 1 << number % 8
        file.data = bytes(damaged)
        self._note("write", path, file, file.data)
        self._note("sync", path, file)
        return path

    def _note(self, kind: str, path: str, file: "_File | None" = None, data: bytes = b"") -> None:
        name = path.removeprefix(ROOT).removeprefix("/") or "."
        self._log.changes.append(Change(kind, name, data, file.inode if file else 0))

    # --- files ----------------------------------------------------------------------------------
    def _file(self, path: str) -> "_File":
        folder, _, name = path.rpartition("/")
        try:
            return self._folders[folder][name]
        except KeyError:
            raise error_of(errno.ENOENT, path) from None

    def _create(self, path: str) -> "_File":
        folder, _, name = path.rpartition("/")
        if folder not in self._folders:
            raise error_of(errno.ENOENT, path)
        self._inodes += 1
        file = self._folders[folder][name] = _File(self._inodes)
        self._note("name", path, file)
        return file

    def _opened(self, path: str) -> "_File":
        return self._file(path) if self.exists(path) else self._create(path)

    def exists(self, path: str) -> bool:
        """Return whether a file or folder exists."""
        self._count()
        folder, _, name = path.rpartition("/")
        return path in self._folders or name in self._folders.get(folder, {})

    def is_folder(self, path: str) -> bool:
        """Return whether a folder exists."""
        self._count()
        return path in self._folders

    def names(self, folder: str) -> list[str]:
        """Return the sorted names of the files and folders in a folder."""
        self._count()
        if folder not in self._folders:
            raise error_of(errno.ENOENT, folder)
        start = f"{folder}/"
        folders = (f.removeprefix(start) for f in self._folders if f.startswith(start))
        return sorted({*self._folders[folder], *(name for name in folders if "/" not in name)})

    def read(self, path: str) -> bytes:
        """Return the content of a file."""
        self._count()
        return self._file(path).data

    def size(self, path: str) -> int:
        """Return the size of a file in bytes."""
        self._count()
        return len(self._file(path).data)

    def inode(self, path: str) -> int:
        """Return the number of a file; a new file has a larger one."""
        return self._file(path).inode

    def write(self, path: str, data: bytes) -> None:
        """Replace the content of a file; a full disk takes half of what is new."""
        self._count(changes=True)
        file = self._opened(path)
        old = file.data
        kept = _common_bytes(old, data)
        is_refused = self.is_full and len(data) > kept
        file.data = new = data[: (kept + len(data)) // 2] if is_refused else data
        if kept < len(old):
            self._note("truncate", path, file)
            self._log.changes[-1].note = kept
        self._note("append" if old else "write", path, file, new[kept:])
        if is_refused:
            raise error_of(errno.ENOSPC, path)

    def rename(self, path: str, target: str) -> None:
        """Rename a file; an existing target is replaced."""
        self._count(changes=True)
        file = self._file(path)
        folder, _, name = target.rpartition("/")
        if folder not in self._folders:
            raise error_of(errno.ENOENT, target)
        source, _, old = path.rpartition("/")
        del self._folders[source][old]
        self._folders[folder][name] = file
        self._note("name", target, file)
        self._log.changes[-1].source = path.removeprefix(f"{ROOT}/")

    def remove(self, path: str) -> None:
        """Remove a file."""
        self._count(changes=True)
        file = self._file(path)
        folder, _, name = path.rpartition("/")
        del self._folders[folder][name]
        self._note("remove", path, file)

    def make_folder(self, path: str) -> None:
        """Create a folder."""
        self._count(changes=True)
        if self.is_full:
            raise error_of(errno.ENOSPC, path)
        if path.rpartition("/")[0] not in self._folders:
            raise error_of(errno.ENOENT, path)
        self._folders[path] = {}
        self._note("folder", path)

    # --- descriptors ----------------------------------------------------------------------------
    def open(self, path: str, flags: int) -> int:
        """Return a file descriptor of a file or folder."""
        if path in self._folders:
            self._count()
            file = None
        elif flags & os.O_CREAT:
            self._count(changes=True)
            file = self._opened(path)
        else:
            self._count()
            file = self._file(path)
        self._descriptor += 1
        self._open[self._descriptor] = path, file
        return self._descriptor

    def sync(self, descriptor: int) -> None:
        """Write a file, or the names in a folder, to the disk."""
        self._count(changes=True)
        path, file = self._open[descriptor]
        self._note("sync", path, file)

    def write_at(self, descriptor: int, data: bytes, offset: int) -> int:
        """Write bytes at a position."""
        path, file = self._open[descriptor]
        assert file is not None
        old = file.data
        self._count(changes=True)
        end = offset + len(data)
        if self.is_full and end > len(old):
            raise error_of(errno.ENOSPC, path)
        file.data = old[:offset] + data + old[end:]
        self._note("write", path, file, file.data)
        return len(data)

    def close(self, descriptor: int) -> None:
        """Close a descriptor."""
        del self._open[descriptor]

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Let the functions of `os` take paths and descriptors of this disk in the block."""
        real = SimpleNamespace(open=os.open, fsync=os.fsync, close=os.close, pwrite=os.pwrite)

        def open_(path: Any, flags: int, *rest: Any, **options: Any) -> int:
            if isinstance(path, DiskPath):
                return self.open(str(path), flags)
            return real.open(path, flags, *rest, **options)

        def fsync(number: int) -> None:
            (self.sync if number > FIRST_DESCRIPTOR else real.fsync)(number)

        def close(number: int) -> None:
            (self.close if number > FIRST_DESCRIPTOR else real.close)(number)

        def pwrite(number: int, data: bytes, offset: int) -> int:
            write = self.write_at if number > FIRST_DESCRIPTOR else real.pwrite
            return write(number, data, offset)

        with (
            patch.object(os, "open", open_),
            patch.object(os, "fsync", fsync),
            patch.object(os, "close", close),
            patch.object(os, "pwrite", pwrite),
        ):
            yield


class _File:
    """Content of a file."""

    __slots__ = ("data", "inode")

    def __init__(self, inode: int) -> None:
        self.data, self.inode = b"", inode


def _common_bytes(one: bytes, other: bytes) -> int:
    """Return the number of equal bytes at the start of two contents."""
    low, high = 0, min(len(one), len(other))
    while low < high:
        middle = (low + high + 1) // 2
        if one[:middle] == other[:middle]:
            low = middle
        else:
            high = middle - 1
    return low
