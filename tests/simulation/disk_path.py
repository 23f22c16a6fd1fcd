"""Path on a simulated disk, in place of `pathlib.Path`."""

import errno
import io
import os
from collections.abc import Iterator
from fnmatch import fnmatchcase
from types import SimpleNamespace
from typing import Protocol


def error_of(number: int, path: str) -> OSError:
    """Return the error of the operating system with a number of `errno`."""
    return OSError(number, os.strerror(number), path)


class Files(Protocol):
    """Operations of a simulated disk on absolute paths."""

    def exists(self, path: str) -> bool: ...

    def is_folder(self, path: str) -> bool: ...

    def names(self, folder: str) -> list[str]: ...

    def read(self, path: str) -> bytes: ...

    def size(self, path: str) -> int: ...

    def inode(self, path: str) -> int: ...

    def write(self, path: str, data: bytes) -> None: ...

    def rename(self, path: str, target: str) -> None: ...

    def remove(self, path: str) -> None: ...

    def make_folder(self, path: str) -> None: ...


class DiskPath:
    """Path on a simulated disk, with the methods of `Path` that `ldo_service` uses.

    It is no subclass of `PurePath`, whose methods would take a quarter of the time of a run.
    """

    __slots__ = ("_path", "disk")

    def __init__(self, disk: Files, path: str) -> None:
        self.disk, self._path = disk, path

    def __truediv__(self, name: str) -> "DiskPath":
        return DiskPath(self.disk, f"{self._path}/{name}")

    def __str__(self) -> str:
        return self._path

    def __fspath__(self) -> str:
        return self._path

    def __repr__(self) -> str:
        return f"DiskPath({self._path})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DiskPath) and other._path == self._path

    def __lt__(self, other: "DiskPath") -> bool:
        return self._path < other._path

    def __hash__(self) -> int:
        return hash(self._path)

    @property
    def name(self) -> str:
        """Last name of the path."""
        return self._path.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """Last name without its suffix."""
        return self.name.rpartition(".")[0] or self.name

    @property
    def parent(self) -> "DiskPath":
        """Folder of the path."""
        return DiskPath(self.disk, self._path.rpartition("/")[0] or "/")

    @property
    def parents(self) -> Iterator["DiskPath"]:
        """Folders above the path, from the bottom to the top."""
        path = self
        while path._path != "/":
            path = path.parent
            yield path

    def with_name(self, name: str) -> "DiskPath":
        """Return the path with another last name."""
        return self.parent / name

    def exists(self) -> bool:
        """Return whether the path exists."""
        return self.disk.exists(self._path)

    def is_dir(self) -> bool:
        """Return whether the path is a folder."""
        return self.disk.is_folder(self._path)

    def stat(self) -> SimpleNamespace:
        """Return the size of a file, and a time of modification that grows with each new file."""
        size, inode = self.disk.size(self._path), self.disk.inode(self._path)
        return SimpleNamespace(st_size=size, st_mtime_ns=inode)

    def iterdir(self) -> Iterator["DiskPath"]:
        """Yield the paths in a folder."""
        for name in self.disk.names(self._path):
            yield self / name

    def glob(self, pattern: str) -> Iterator["DiskPath"]:
        """Yield the paths below this folder that match a pattern such as `*/name`."""
        first, _, rest = pattern.partition("/")
        for name in self.disk.names(self._path) if self.is_dir() else ():
            if fnmatchcase(name, first):
                if rest:
                    yield from (self / name).glob(rest)
                else:
                    yield self / name

    def read_bytes(self) -> bytes:
        """Return the content of the file."""
        return self.disk.read(self._path)

    def write_bytes(self, data: bytes) -> int:
        """Replace the content of the file."""
        self.disk.write(self._path, bytes(data))
        return len(data)

    def replace(self, target: "DiskPath") -> "DiskPath":
        """Rename the file."""
        self.disk.rename(self._path, str(target))
        return target

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the file."""
        if not missing_ok or self.exists():
            self.disk.remove(self._path)

    def mkdir(self, parents: bool = False, exist_ok: bool = False) -> None:
        """Create the folder."""
        if self.is_dir():
            if not exist_ok:
                raise error_of(errno.EEXIST, str(self))
            return
        if parents and not self.parent.exists():
            self.parent.mkdir(parents=True, exist_ok=True)
        self.disk.make_folder(self._path)

    def open(self, mode: str = "r") -> "OpenFile":
        """Open the file; a change is written when the file is closed."""
        if mode.startswith("w"):
            self.disk.write(self._path, b"")
        return OpenFile(self, self.disk.read(self._path), is_written=mode != "rb")


class OpenFile(io.BytesIO):
    """Open file of a simulated disk."""

    def __init__(self, path: DiskPath, data: bytes, *, is_written: bool) -> None:
        super().__init__(data)
        self._path, self._old, self._is_written = path, data, is_written

    def close(self) -> None:
        """Write the changes."""
        data = b"" if self.closed else self.getvalue()
        is_new = not self.closed and self._is_written and data != self._old
        super().close()
        if is_new:
            self._path.write_bytes(data)

    def __exit__(self, *exception: object) -> None:
        self.close()
