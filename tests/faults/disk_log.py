"""Log of all changes of a folder, and the states in which a power cut may leave it.

The method is that of ALICE (Pillai et al., OSDI 2014). Without a sync, the content of a file may be
lost, cut or partly zero, and a created, renamed or removed name may be old or new. A synced file
has its content, and a synced folder has its names. Unlike the ext4 of ALICE, the model keeps no
order between two changes that are not synced.
"""

import os
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from ldo_service.storage.message_log import MessageLog

BLOCK_BYTES = 4096


@dataclass
class Change:
    """One operation on the disk."""

    kind: str  # "write", "append", "truncate", "name", "remove", "folder", "sync" or "note".
    path: str = ""
    data: bytes = b""
    inode: int = 0
    source: str = ""  # Old name of a renamed file.
    note: Any = None  # A fact; the new size in bytes of a truncated file.


@dataclass
class DiskLog:
    """Changes of a folder, recorded while `recorded` is open."""

    root: Path
    changes: list[Change] = field(default_factory=list)
    _inodes: dict[str, int] = field(default_factory=dict)
    _count: int = 0

    def note(self, note: object) -> None:
        """Add a fact that holds from here on, such as a saved step."""
        self.changes.append(Change("note", note=note))

    def _name(self, path: Path | str) -> str | None:
        name = os.path.relpath(path, self.root)
        return None if name.startswith("..") else name

    def _written(self, path: Path, data: bytes) -> None:
        name = self._name(path)
        if name is None:
            return
        if name not in self._inodes:
            self._count += 1
            self._inodes[name] = self._count
            self.changes.append(Change("name", name, inode=self._count))
        self.changes.append(Change("write", name, bytes(data), self._inodes[name]))

    def _appended(self, path: Path, data: bytes) -> None:
        name = self._name(path)
        if name is None:
            return
        if name not in self._inodes:
            self._written(path, data)
        else:
            self.changes.append(Change("append", name, data, self._inodes[name]))

    def _renamed(self, old: Path, new: Path) -> None:
        source, name = self._name(old), self._name(new)
        if source is not None and name is not None:
            inode = self._inodes[name] = self._inodes.pop(source)
            self.changes.append(Change("name", name, inode=inode, source=source))

    def _removed(self, path: Path) -> None:
        name = self._name(path)
        if name is not None and self._inodes.pop(name, None) is not None:
            self.changes.append(Change("remove", name))

    def _made(self, path: Path) -> None:
        name = self._name(path)
        if name is not None:
            self.changes.append(Change("folder", name))

    def _synced(self, number: int) -> None:
        name = self._name(os.readlink(f"/proc/self/fd/{number}"))
        if name is not None:
            self.changes.append(Change("sync", name, inode=self._inodes.get(name, 0)))


@contextmanager
def recorded(root: Path) -> Iterator[DiskLog]:
    """Record the changes below a folder that `ldo_service.storage` makes in the block."""
    log = DiskLog(root)
    write_bytes, replace, unlink, mkdir = Path.write_bytes, Path.replace, Path.unlink, Path.mkdir
    fsync, append = os.fsync, MessageLog._write

    def on_write(path: Path, data: bytes) -> int:
        size = write_bytes(path, data)
        log._written(path, data)
        return size

    def on_replace(path: Path, target: Path) -> Path:
        result = replace(path, target)
        log._renamed(path, target)
        return result

    def on_unlink(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok)
        log._removed(path)

    def on_mkdir(path: Path, *arguments: Any, **options: Any) -> None:
        is_new = not path.exists()
        mkdir(path, *arguments, **options)
        if is_new:
            log._made(path)

    def on_fsync(number: int) -> None:
        fsync(number)
        log._synced(number)

    def on_append(messages: MessageLog, segment: Any, message: Any) -> int:
        size, syncs = segment.size, messages._syncs
        messages._syncs = False
        end = append(messages, segment, message)
        messages._syncs = syncs
        log._appended(segment.path, segment.path.read_bytes()[size:end])
        if syncs:
            with segment.path.open("rb") as file:
                os.fsync(file.fileno())
            number = os.open(segment.path.parent, os.O_RDONLY)
            os.fsync(number)
            os.close(number)
        return end

    with (
        patch.object(Path, "write_bytes", on_write),
        patch.object(Path, "replace", on_replace),
        patch.object(Path, "unlink", on_unlink),
        patch.object(Path, "mkdir", on_mkdir),
        patch.object(os, "fsync", on_fsync),
        patch.object(MessageLog, "_write", on_append),
    ):
        yield log


@dataclass(frozen=True)
class CrashState:
    """Content of a folder after a power cut."""

    files: dict[str, bytes]
    last_note: Any  # The last note before the power cut.

    def write(self, root: Path) -> None:
        """Write the files to an empty folder."""
        for name, data in self.files.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


# Probability that a change without sync reaches the disk: nothing, half, nearly all, or all of
# them as after a killed process.
SURVIVAL = (0.0, 0.5, 0.9, 1.0)


def crash_state(log: DiskLog, end: int, rng: random.Random) -> CrashState:
    """Return a random state in which a power cut after the first `end` changes leaves the folder.

    Args:
        log: The recorded changes.
        end: Number of changes before the power cut.
        rng: Source of the lost changes.
    """
    changes = log.changes[:end]
    survival = rng.choice(SURVIVAL)
    safe_data, safe_names = _synced_changes(changes)
    names: dict[str, int] = {}
    data: dict[int, bytes] = {}
    folders, note = {"."}, None
    for number, change in enumerate(changes):
        is_kept = rng.random() < survival
        match change.kind:
            case "note":
                note = change.note
            case "write" | "append":
                before = data.get(change.inode, b"") if change.kind == "append" else b""
                is_safe = number in safe_data or is_kept
                new = change.data if is_safe else _damaged(change.data, rng)
                data[change.inode] = before + new
            case "truncate":  # The service cuts off nothing but the rest of a failed write.
                data[change.inode] = data.get(change.inode, b"")[: change.note]
            case "folder" if number in safe_names or is_kept:
                folders.add(change.path)
            case "name" if number in safe_names or is_kept:
                names.pop(change.source, None)
                names[change.path] = change.inode
            case "remove" if number in safe_names or is_kept:
                names.pop(change.path, None)
    files = {
        name: data.get(inode, b"")
        for name, inode in names.items()
        if all(str(parent) in folders for parent in Path(name).parents)
    }
    return CrashState(files, note)


def _synced_changes(changes: list[Change]) -> tuple[set[int], set[int]]:
    """Return the numbers of the changes of content, and of names, that a later sync made safe."""
    data, names = set(), set()
    synced_inodes: set[int] = set()
    synced_folders: set[str] = set()
    for number in range(len(changes) - 1, -1, -1):
        change = changes[number]
        if change.kind == "sync":
            synced_inodes.add(change.inode)
            synced_folders.add(change.path)
        elif change.kind in ("write", "append") and change.inode in synced_inodes:
            data.add(number)
        elif str(Path(change.path).parent) in synced_folders:
            names.add(number)
    return data, names


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """Return what may be left of content that was not synced."""
    kept = rng.randrange(len(data) + 1) if data else 0
    match rng.randrange(3):
        case 0:
            return b""
        case 1:
            return data[:kept]
        case _:
            kept -= kept % BLOCK_BYTES
            return data[:kept] + bytes(len(data) - kept)
