"""Folders on disk or in a bucket, read and written through fsspec."""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem
from fsspec.registry import known_implementations

from ldo_service.errors import ConfigError, DataError, did_you_mean, install_command
from ldo_service.storage.atomic_write import write_atomically

EXTRAS = {"s3": "s3", "s3a": "s3"}  # Extras of this package by the protocol that they add.
# Fields of a listing that identify the content of a file, by preference. All are checksums that the
# store computes when a file is written.
CHECKSUMS = ("ETag", "etag", "md5Hash", "content_md5", "crc32c", "checksum")
MODIFIED = ("LastModified", "updated", "last_modified", "mtime", "created")


@dataclass(frozen=True, slots=True)
class StoredFile:
    """File of a store.

    Attributes:
        name: Path relative to the listed folder, with slashes.
        size_bytes: Size of the file.
        mark: Text that changes with the content. It is a checksum, or the time of the last change
            if the store has no checksum.
    """

    name: str
    size_bytes: int
    mark: str


@dataclass(frozen=True, slots=True)
class Store:
    """Folder or file on disk or in a bucket, accessed through fsspec.

    Attributes:
        url: The address: an absolute path, or PROTOCOL://PATH.
        system: File system of fsspec.
        path: Path in the file system.
    """

    url: str
    system: Any
    path: str

    @property
    def is_local(self) -> bool:
        """True if the store is on a disk of this machine."""
        return isinstance(self.system, LocalFileSystem)

    @property
    def local(self) -> Path:
        """Path of a local store."""
        assert self.is_local
        return Path(self.path)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return PurePosixPath(self.path).name

    def at(self, *parts: str) -> "Store":
        """Return a folder or a file below this one."""
        below = "/".join(parts)
        url, path = (f"{whole.rstrip('/')}/{below}" for whole in (self.url, self.path))
        return Store(url, self.system, path)

    def exists(self) -> bool:
        """Return whether the folder or the file exists."""
        with self._reported("read"):
            self.system.invalidate_cache()
            return self.system.exists(self.path)

    def is_file(self) -> bool:
        """Return whether the path is a file."""
        with self._reported("read"):
            return self.system.isfile(self.path)

    def matches(self) -> list["Entry"]:
        """Return all files and folders that match this path, a glob pattern, in sorted order."""
        with self._reported("read"):
            found = self.system.glob(self.path, detail=True)
        return self._entries(found.values())

    def entries(self) -> list["Entry"]:
        """Return all folders and files directly in the folder, sorted."""
        with self._reported("read"):
            return self._entries(self.system.ls(self.path, detail=True))

    def _entries(self, found: Iterable[dict[str, Any]]) -> list["Entry"]:
        entries = []
        for info in sorted(found, key=lambda info: info["name"]):
            path = info["name"].rstrip("/")
            if path.strip("/") != self.path.strip("/"):
                url = path if self.is_local else self.system.unstrip_protocol(path)
                entries.append(Entry(Store(url, self.system, path), info["type"] == "file"))
        return entries

    def files(self) -> list[StoredFile]:
        """Return all files below the folder, sorted; if the path is a file, return it alone."""
        with self._reported("read"):
            self.system.invalidate_cache()
            found = self.system.find(self.path, detail=True)
        is_itself = list(found) == [self.path]
        base = str(PurePosixPath(self.path).parent) if is_itself else self.path
        named = [(path[len(base) :].strip("/"), info) for path, info in sorted(found.items())]
        # Some programs write an empty file with the name of a folder into a bucket.
        return [StoredFile(n, int(info["size"] or 0), _mark(info)) for n, info in named if n]

    def read(self) -> bytes | None:
        """Return the content of the file; None if it does not exist."""
        try:
            self.system.invalidate_cache()
            return self.system.cat_file(self.path)
        except FileNotFoundError:
            return None
        except Exception as error:
            raise _as_data_error(self.url, "read", error) from error

    def write(self, content: bytes) -> None:
        """Write or replace the file; a reader sees the whole old or the whole new content."""
        with self._reported("written"):
            if self.is_local:
                self.local.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self.local, content)
            else:
                self.system.pipe_file(self.path, content)

    def download(self, target: Path) -> None:
        """Copy the folder or the file to a local path, which must not exist yet."""
        with self._reported("read"):
            if self.system.isfile(self.path):
                self.system.get_file(self.path, str(target))
            else:
                self.system.get(self.path.rstrip("/") + "/", str(target), recursive=True)

    def upload(self, file: Path) -> None:
        """Write the content of a local file to this path."""
        with self._reported("written"):
            self.system.put_file(str(file), self.path)

    def remove(self) -> None:
        """Remove the file or the folder, if it exists."""
        with self._reported("written"):
            self.system.invalidate_cache()
            if self.system.exists(self.path):
                self.system.rm(self.path, recursive=True)

    @contextmanager
    def _reported(self, access: str) -> Iterator[None]:
        """Convert every error inside the context to a DataError that names the address.

        The libraries behind fsspec raise exceptions of many unrelated classes.
        """
        try:
            yield
        except Exception as error:
            raise _as_data_error(self.url, access, error) from error


@dataclass(frozen=True, slots=True)
class Entry:
    """Folder or file in a listing."""

    store: Store  # The folder or file.
    is_file: bool  # False for a folder.


def open_store(url: str) -> Store:
    """Open a folder or a file by its path or its address PROTOCOL://PATH.

    The function reads and creates no file.

    Raises:
        ConfigError: The protocol is unknown, or a package that it needs is not installed.
    """
    protocol, mark, _ = url.partition("://")
    if not mark:
        path = str(Path(url).expanduser().absolute())
        return Store(path, LocalFileSystem(), path)
    name = protocol.split("::")[-1]
    if name not in known_implementations and name not in fsspec.available_protocols():
        hint = did_you_mean(name, known_implementations, "Examples are s3:// and gs://.")
        raise ConfigError(f"{url}: the protocol {name}:// is unknown. {hint}")
    try:
        system, path = fsspec.url_to_fs(url)
    except ImportError as error:
        extra = EXTRAS.get(name)
        how = install_command(extra) if extra else known_implementations[name].get("err", error)
        advice = f"the extra `{extra}`. Install it by {how}" if extra else f"another package: {how}"
        raise ConfigError(f"{url}: the protocol {name}:// needs {advice}.") from error
    except Exception as error:
        raise ConfigError(
            f"{url} cannot be opened: {reason_of(error)}. Check the address and your credentials."
        ) from error
    return Store(url.rstrip("/"), system, path.rstrip("/"))


def _mark(info: dict[str, Any]) -> str:
    name = next((name for name in (*CHECKSUMS, *MODIFIED) if info.get(name)), None)
    return "" if name is None else f"{name}={info[name]}"


def _as_data_error(url: str, access: str, error: Exception) -> DataError:
    if isinstance(error, DataError):
        return error
    return DataError(
        f"{url} cannot be {access}: {reason_of(error)}. Check the address and your access rights."
    )


def reason_of(error: Exception) -> str:
    """Return the text of an error on one line, without its final period."""
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list):
        return str(error.args[0][0][-1])  # Files that were not copied: source, target and reason.
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return (" ".join(str(error).split()) or type(error).__name__).removesuffix(".")
