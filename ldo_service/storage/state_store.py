"""Stores of the last state of each actor, from which a restored actor continues.

A state consists of a few named parts. A store skips a part that is the same Python object as in the
last save. Callers must therefore never modify a part that was saved; they replace it.
"""

import logging
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import msgspec

from ldo_service.errors import DataError

from .atomic_write import sync, write_atomically
from .state_codec import decode_state, encode_state

log = logging.getLogger(__name__)


# Named parts of an actor's state, each of plain values, bytes and NumPy arrays. A part that did not
# change since the last step is the same object: only new objects are written.
State = Mapping[str, Any]
CONTENTS = "contents.msgpack"
# Version of the content of the parts. Increment it when a change of any actor's state makes older
# states incompatible. States of version 1 contain no version number.
STATE_VERSION = 3


class _Contents(msgspec.Struct, frozen=True):
    """Content of `contents.msgpack`: file name of each part of a state, and format version."""

    files: dict[str, str]
    version: int = STATE_VERSION


class StateStore(Protocol):
    """Store of the last state of each actor."""

    @property
    def syncs(self) -> bool:
        """True if a saved state survives a power cut."""
        ...

    def backlog_folder(self, actor: str) -> Path | None:
        """Return the folder for messages that an actor's consumers have not handled.

        Returns:
            The folder; None if the store is in memory.
        """
        ...

    def quarantine_folder(self, actor: str) -> Path | None:
        """Return the folder for messages that end an actor's process.

        Returns:
            The folder; None if the store is in memory, which does not survive the process either.
        """
        ...

    def save(self, actor: str, state: State) -> None:
        """Replace the state of an actor; an empty state is ignored."""
        ...

    def load(self, actor: str) -> State | None:
        """Load the last state of an actor; None if there is none."""
        ...

    def delete(self, actor: str) -> None:
        """Delete the state of an actor."""
        ...


class MemoryStore:
    """Store in memory; the states are lost when the process ends, but not when an actor fails."""

    syncs = False

    def __init__(self) -> None:
        self._states: dict[str, State] = {}

    def backlog_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None: unhandled messages are kept in memory, as the states are."""
        return

    def quarantine_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None: the deliveries of messages are not counted."""
        return

    def save(self, actor: str, state: State) -> None:
        """Replace the state of an actor; an empty state is ignored."""
        if state:
            self._states[actor] = dict(state)

    def load(self, actor: str) -> State | None:
        """Return the last state of an actor; None if there is none."""
        return self._states.get(actor)

    def delete(self, actor: str) -> None:
        """Delete the state of an actor."""
        self._states.pop(actor, None)


class FolderStore:
    """Store in files of a folder `<folder>/<actor>/`, which survive a killed process.

    Each part has a file, and `contents.msgpack` lists the files of the current state. A changed
    part is written to a new file. The list is replaced last, by one rename. A reader therefore
    finds the whole old state or the whole new state.
    """

    def __init__(self, folder: Path, *, syncs: bool = False) -> None:
        """Initialize the store without reading any file.

        Args:
            folder: Folder of all states.
            syncs: Sync every file to the disk, so that the state survives a power cut too.
        """
        self._folder, self.syncs = folder, syncs
        self._saved: dict[str, State] = {}
        self._files: dict[str, dict[str, str]] = {}  # File of each part, by actor.

    def backlog_folder(self, actor: str) -> Path:
        """Return the folder for messages that an actor's consumers have not handled."""
        return self._folder / f"{actor}.backlog"

    def quarantine_folder(self, actor: str) -> Path:
        """Return the folder for messages that end an actor's process."""
        return self._folder / f"{actor}.quarantine"

    def save(self, actor: str, state: State) -> None:
        """Replace the state of an actor; an empty state is ignored.

        Raises:
            OSError: The state cannot be written; the old state stays unchanged.
        """
        if not state:
            return
        folder = self._folder / actor
        folder.mkdir(parents=True, exist_ok=True)
        if actor not in self._saved:
            if self.syncs:
                sync(self._folder)
            self._files[actor] = _read_contents_or_nothing(folder)
            _remove_unreferenced(folder, self._files[actor])
        saved, old = self._saved.get(actor, {}), self._files[actor]
        new = dict(old)
        for part, value in state.items():
            if part not in saved or saved[part] is not value:
                new[part] = f"{part}.b" if old.get(part) == f"{part}.a" else f"{part}.a"
                self._write(folder / new[part], encode_state(value))
        new = {part: new[part] for part in state}
        if new != old:
            self._saved.pop(actor, None)  # The list may now refer to the new files.
            body = msgspec.msgpack.encode(_Contents(new))
            write_atomically(folder / CONTENTS, body, syncs=self.syncs)
        for file in set(old.values()) - set(new.values()):
            _remove(folder / file)
        self._saved[actor], self._files[actor] = dict(state), new

    def _write(self, path: Path, body: bytes) -> None:
        path.write_bytes(body)
        if self.syncs:
            sync(path)

    def load(self, actor: str) -> State | None:
        """Load the last state of an actor.

        If the state is damaged, the error is logged and the folder of the state is renamed to
        `<actor>.unreadable`. An earlier folder of that name is deleted.

        Returns:
            The state; None if there is none or it is damaged.

        Raises:
            DataError: The state cannot be read because of the disk or a limit of the process, or
                another version of the service wrote the state.
        """
        folder = self._folder / actor
        try:
            files = _read_contents(folder)
            parts = {
                part: decode_state((folder / file).read_bytes()) for part, file in files.items()
            }
        except (FileNotFoundError, ValueError) as error:  # A file name may contain a null byte.
            log.error(
                "%s: the saved state cannot be read: %s. The actor starts with an empty state; the "
                "damaged state is kept as %s.unreadable.",
                actor, error, folder,
            )  # fmt: skip
            _set_aside(folder)
            return None
        except OSError as error:
            raise DataError(
                f"the state of {actor} in {folder} cannot be read: {error.strerror}. The state is "
                "unchanged: repair the disk, or raise the limit of the process, and start again."
            ) from error
        return parts or None

    def delete(self, actor: str) -> None:
        """Delete the state of an actor."""
        folder = self._folder / actor
        self._saved.pop(actor, None)
        (folder / CONTENTS).unlink(missing_ok=True)  # First, because unlisted files are not read.
        for file in folder.glob("*"):
            _remove(file)


def _set_aside(folder: Path) -> None:
    aside = folder.with_name(f"{folder.name}.unreadable")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        folder.rename(aside)
    except OSError as error:
        log.error(
            "cannot move the unreadable state %s to %s (%s); the next checkpoint overwrites it. "
            "Copy it now if you need it.",
            folder, aside.name, error.strerror,
        )  # fmt: skip


def _remove_unreferenced(folder: Path, files: Mapping[str, str]) -> None:
    """Remove the files that are not in `files`, such as those that killed processes have left."""
    for file in folder.glob("*"):
        if file.name not in (CONTENTS, *files.values()):
            _remove(file)


def _remove(file: Path) -> None:
    """Remove a file that `contents.msgpack` does not list.

    If that fails, the next process removes it.
    """
    with suppress(OSError):
        file.unlink()


def _read_contents(folder: Path) -> dict[str, str]:
    """Return the file name of each part of a state; empty if no state was saved.

    Raises:
        DataError: Another version of the service wrote the state.
        msgspec.DecodeError: The contents are damaged.
    """
    try:
        body = (folder / CONTENTS).read_bytes()
    except FileNotFoundError:
        return {}
    try:
        contents = msgspec.msgpack.decode(body, type=_Contents)
    except msgspec.ValidationError:
        msgspec.msgpack.decode(
            body, type=dict[str, str]
        )  # Format of version 1; an error if damaged.
        contents = _Contents({}, version=1)
    if contents.version != STATE_VERSION:
        raise DataError(
            f"{folder / CONTENTS} has version={contents.version}, and this service reads "
            f"{STATE_VERSION}: another version of the service wrote this state. Choose another "
            "folder with --state, or use the version that wrote it."
        )
    return contents.files


def _read_contents_or_nothing(folder: Path) -> dict[str, str]:
    try:
        return _read_contents(folder)
    except msgspec.DecodeError:
        return {}
