"""Where the last state of each actor is kept, so that a successor goes on.

A state is a few named parts. Only a part that is a new object is written, so the parts given must
not be changed afterwards.
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
# Version of what the parts hold. A change of any actor's state that an older state does not fit
# increments it. Version 1 had no number.
STATE_VERSION = 2


class _Contents(msgspec.Struct, frozen=True):
    """The files of an actor's state, by part, and the version of what they hold."""

    files: dict[str, str]
    version: int = STATE_VERSION


class StateStore(Protocol):
    def save(self, actor: str, state: State) -> None: ...

    def load(self, actor: str) -> State | None: ...

    def delete(self, actor: str) -> None:
        """As if nothing had been saved."""
        ...


class MemoryStore:
    """Outlives an actor that failed, not its process."""

    def __init__(self) -> None:
        self._states: dict[str, State] = {}

    def save(self, actor: str, state: State) -> None:
        if state:
            self._states[actor] = dict(state)

    def load(self, actor: str) -> State | None:
        return self._states.get(actor)

    def delete(self, actor: str) -> None:
        self._states.pop(actor, None)


class FolderStore:
    """`<folder>/<actor>/`: outlives a killed process.

    Each part has a file, and `contents.msgpack` names the files that belong together. A new part
    goes to a new file and the contents change last, in one rename: a reader finds the whole old
    state or the whole new one. `syncs`: after a power cut too; otherwise that may cost it.
    """

    def __init__(self, folder: Path, *, syncs: bool = False) -> None:
        self._folder, self._syncs = folder, syncs
        self._saved: dict[str, State] = {}
        self._files: dict[str, dict[str, str]] = {}  # by actor: part to file

    def save(self, actor: str, state: State) -> None:
        if not state:
            return
        folder = self._folder / actor
        folder.mkdir(parents=True, exist_ok=True)
        if actor not in self._saved:
            if self._syncs:
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
            self._saved.pop(actor, None)  # these files may be named from now on, whatever fails
            body = msgspec.msgpack.encode(_Contents(new))
            write_atomically(folder / CONTENTS, body, syncs=self._syncs)
        for file in set(old.values()) - set(new.values()):
            _remove(folder / file)
        self._saved[actor], self._files[actor] = dict(state), new

    def _write(self, path: Path, body: bytes) -> None:
        path.write_bytes(body)
        if self._syncs:
            sync(path)

    def load(self, actor: str) -> State | None:
        """None when nothing was saved, or what was saved makes no sense: said in the log, and
        kept beside it, the last time it happened, for whoever can make something of it.

        Raises DataError where there is something and the disk, or a limit, does not let it be read,
        or where another version of the service wrote it.
        """
        folder = self._folder / actor
        try:
            files = _read_contents(folder)
            parts = {
                part: decode_state((folder / file).read_bytes()) for part, file in files.items()
            }
        except (FileNotFoundError, ValueError) as error:  # a name may hold a null byte
            log.error("%s: its saved state cannot be read and is left out: %s", actor, error)
            _set_aside(folder)
            return None
        except OSError as error:
            raise DataError(
                f"the state of {actor} in {folder} cannot be read: {error.strerror}. It is as it "
                "was: mend the disk, or raise the limit that was met, and start again."
            ) from error
        return parts or None

    def delete(self, actor: str) -> None:
        folder = self._folder / actor
        self._saved.pop(actor, None)
        (folder / CONTENTS).unlink(missing_ok=True)  # first: what it does not name is not read
        for file in folder.glob("*"):
            _remove(file)


def _set_aside(folder: Path) -> None:
    aside = folder.with_name(f"{folder.name}.unreadable")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        folder.rename(aside)
    except OSError as error:
        log.error("%s cannot be kept as %s: %s", folder, aside.name, error.strerror)


def _remove_unreferenced(folder: Path, files: Mapping[str, str]) -> None:
    """Remove what a killed process wrote and did not name, or no longer named."""
    for file in folder.glob("*"):
        if file.name not in (CONTENTS, *files.values()):
            _remove(file)


def _remove(file: Path) -> None:
    """One that nothing names: if it stays, it costs space until the next process sweeps."""
    with suppress(OSError):
        file.unlink()


def _read_contents(folder: Path) -> dict[str, str]:
    """Return the files of a state, by part; none where nothing was saved.

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
        msgspec.msgpack.decode(body, type=dict[str, str])  # As version 1 wrote it, or damaged.
        contents = _Contents({}, version=1)
    if contents.version != STATE_VERSION:
        raise DataError(
            f"{folder / CONTENTS} has version={contents.version}, and this service reads "
            f"{STATE_VERSION}: another version of the service wrote this state. Choose another "
            "folder with --state, or go on with the version that wrote it."
        )
    return contents.files


def _read_contents_or_nothing(folder: Path) -> dict[str, str]:
    try:
        return _read_contents(folder)
    except msgspec.DecodeError:
        return {}
