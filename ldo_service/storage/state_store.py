"""Stores of the last state of each actor, from which a restored actor continues.

A state consists of a few named parts. `save` does not write a part that is the same Python object
as in the last save. A caller that changes a saved part must therefore replace it by a new object.
"""

import errno
import logging
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import msgspec

from ldo_service.errors import DamagedStateError, DataError

from .atomic_write import make_folder, sync, write_atomically
from .generation_files import GenerationFiles
from .state_codec import encode_state
from .state_contents import StateContents, check_of, read_contents

log = logging.getLogger(__name__)


# Named parts of an actor's state, each of plain values, bytes and NumPy arrays. A part that did not
# change since the last step is the same object: only new objects are written.
State = Mapping[str, Any]
CONTENTS = "contents.msgpack"
GENERATION = "generation-{}.msgpack"  # File name of the list of a generation.
NEWEST = 0  # Number that stands for the state after the last step, which is no generation.


class StateStore(Protocol):
    """Store of the last state of each actor."""

    syncs: bool  # A saved state survives a power cut.
    has_generations: bool  # The service keeps older generations of the states.

    def backlog_folder(self, actor: str) -> Path | None:
        """Return the folder for messages that an actor's consumers have not handled.

        Returns:
            The folder; None if the store is in memory.
        """
        ...

    def quarantine_folder(self, actor: str) -> Path | None:
        """Return the folder for messages that repeatedly ended the process of an actor.

        Returns:
            The folder; None if the store is in memory, because memory is lost with the process.
        """
        ...

    def save(self, actor: str, state: State, unsynced: Iterable[Path] = ()) -> None:
        """Replace the state of an actor; an empty state is ignored. See `FolderStore.save`."""
        ...

    def load(self, actor: str) -> State | None:
        """Load the last state of an actor; None if there is none."""
        ...

    def delete(self, actor: str) -> None:
        """Delete the state of an actor."""
        ...

    def keep(
        self, actor: str, generation: int, completed: int, unsynced: Iterable[Path] = ()
    ) -> GenerationFiles | None:
        """Keep a copy of the last saved state as a generation; see `FolderStore.keep`."""
        ...

    def is_kept(self, actor: str) -> bool:
        """Return whether an older copy (generation) of the actor's state exists."""
        ...

    def give_up(self, actor: str) -> None:
        """Delete all older copies (generations) of an actor's state, but not its newest state."""
        ...

    def has_fallen_back(self, actor: str) -> bool:
        """Return whether the last loaded state of an actor is an older copy (generation)."""
        ...


class FolderStore:
    """Store on disk, with a folder `<folder>/<actor>/` for the state of each actor.

    Each part has a file that is never changed, and `contents.msgpack` lists the files of the
    current state with their sizes and checksums. A changed part is written to a new file. The list
    is replaced last, by one rename. A reader therefore finds the whole old state or the whole new
    state, or detects a damaged or missing file.

    A power cut may damage files that are not synced. `keep` therefore makes a generation: synced
    copies of the files of the current state, with the list `generation-<number>.msgpack`. The
    states of all actors in one generation belong together; see `runtime.generations`.
    """

    def __init__(self, folder: Path, *, syncs: bool = False, has_generations: bool = True) -> None:
        """Initialize the store without reading any file.

        Args:
            folder: Folder of all states.
            syncs: Sync every file to the disk, so that the state survives a power cut too.
            has_generations: Whether the service keeps generations of the states.
        """
        self.folder, self.syncs, self.has_generations = folder, syncs, has_generations
        self._saved: dict[str, State] = {}
        self._contents: dict[str, StateContents] = {}  # Current state, by actor.
        self._kept: dict[str, dict[int, StateContents]] = {}  # Files by actor and generation.
        self._last_file: dict[str, int] = {}  # Number of the last file, by actor.
        # File of the last kept generation, by actor and file of the state that it is a copy of.
        self._copies: dict[str, dict[str, str]] = {}
        self._writing: dict[str, GenerationFiles] = {}  # Last kept generation, by actor.
        self._fallen_back: set[str] = set()

    def backlog_folder(self, actor: str) -> Path:
        """Return the folder for messages that an actor's consumers have not handled."""
        return self.folder / f"{actor}.backlog"

    def quarantine_folder(self, actor: str) -> Path:
        """Return the folder for messages that repeatedly ended the process of an actor."""
        return self.folder / f"{actor}.quarantine"

    # --- current state ----------------------------------------------------------------------------
    def save(self, actor: str, state: State, unsynced: Iterable[Path] = ()) -> None:
        """Replace the state of an actor; an empty state is ignored.

        Args:
            actor: Name of the actor.
            state: The state.
            unsynced: Files to which the state refers, and which are possibly not synced to the disk
                yet. The store saves their paths; `SavedFiles` checks the files later.

        Raises:
            OSError: The state cannot be written; the old state stays unchanged.
        """
        if not state:
            return
        folder = self.folder / actor
        if actor not in self._saved:
            make_folder(folder)
            self._open(actor)
        saved, old = self._saved.get(actor, {}), self._contents[actor]
        changed = {p: v for p, v in state.items() if p not in saved or saved[p] is not v}
        new = self._write_parts(actor, changed)
        files = {part: new.files.get(part) or old.files[part] for part in state}
        checks = {part: new.checks.get(part) or old.checks[part] for part in state}
        paths = self._relative(unsynced)
        if new.files or files != old.files or paths != old.unsynced:
            self._saved.pop(actor, None)  # The list may now refer to the new files.
            if self.syncs:
                sync(folder)
            self._write_contents(actor, StateContents(files, checks=checks, unsynced=paths))
        self._remove_unused(actor, [*old.files.values(), *self._pop_copied(actor)])
        self._saved[actor] = dict(state)

    def _write_contents(self, actor: str, contents: StateContents) -> None:
        self._contents[actor] = contents
        path = self.folder / actor / CONTENTS
        write_atomically(path, contents.encode(), syncs=self.syncs)

    def _relative(self, paths: Iterable[Path]) -> tuple[str, ...]:
        return tuple(os.path.relpath(path, self.folder.parent) for path in paths)

    def _write_parts(self, actor: str, parts: State) -> StateContents:
        """Write parts to new files; if that fails, remove these files."""
        files: dict[str, str] = {}
        checks: dict[str, tuple[int, int]] = {}
        folder = self.folder / actor
        try:
            for part, value in parts.items():
                body = encode_state(value)
                files[part] = self._new_file(actor, part)
                path = folder / files[part]
                path.write_bytes(body)
                if self.syncs:
                    sync(path)
                checks[part] = check_of(body)
        except OSError:
            for file in files.values():
                _remove(folder / file)
            raise
        return StateContents(files, checks=checks)

    def _new_file(self, actor: str, part: str) -> str:
        """Return a file name that no other file of the actor has."""
        self._last_file[actor] += 1
        return f"{part}.{self._last_file[actor]}"

    def load(
        self, actor: str, generation: int = NEWEST, prefixes: tuple[str, ...] = ("",)
    ) -> State | None:
        """Load a state of an actor, and compare its files with their checksums.

        Args:
            actor: Name of the actor.
            generation: Number of an older copy to load; by default the newest state is loaded.
            prefixes: Load only the parts whose names begin with one of these prefixes.

        Returns:
            The state; None if there is none.

        Raises:
            DamagedStateError: A file is missing or damaged. The files are unchanged.
            DataError: The state cannot be read because of the disk or a limit of the process, or
                another version of the service wrote the state.
        """
        folder = self.folder / actor
        try:
            contents = read_contents(folder / list_name(generation))
            parts = contents.files if contents else {}
            state = {
                part: contents.read_part(folder, part)
                for part in parts
                if contents and part.startswith(prefixes)
            }
        except (FileNotFoundError, ValueError) as error:  # A file name may contain a null byte.
            raise DamagedStateError(
                f"the state of {actor} in {folder} is damaged: {error}"
            ) from error
        except OSError as error:
            if error.errno == errno.EIO:
                raise DamagedStateError(
                    f"the state of {actor} in {folder} cannot be read: {error.strerror}"
                ) from error
            raise DataError(
                f"the state of {actor} in {folder} cannot be read: {error.strerror}. The state is "
                "unchanged. Repair the disk, or raise the limit that the process has reached (for "
                "open files, `ulimit -n`), and start again."
            ) from error
        if contents and generation == NEWEST and contents.generation:
            self._fallen_back.add(actor)
        return state or None

    def delete(self, actor: str) -> None:
        """Delete the state of an actor, and all its generations."""
        folder = self.folder / actor
        self._forget(actor)
        for path in (folder / CONTENTS, *folder.glob(GENERATION.format("*"))):
            path.unlink(missing_ok=True)  # First, because unlisted files are not read.
        for file in folder.glob("*"):
            _remove(file)

    def _pop_copied(self, actor: str) -> Iterable[str]:
        """Return the files that the last kept generation does not need any more."""
        writing = self._writing.get(actor)
        return self._writing.pop(actor).sources.values() if writing and writing.is_written else ()

    def _forget(self, actor: str) -> None:
        for known in (self._saved, self._contents, self._kept, self._copies, self._writing):
            known.pop(actor, None)

    def _open(self, actor: str) -> None:
        """Read the lists of files, and remove the files that no list has.

        Killed processes have left them.
        """
        folder = self.folder / actor
        try:
            contents = read_contents(folder / CONTENTS)
        except DamagedStateError:
            contents = None
        self._contents[actor] = contents or StateContents({})
        self._kept[actor] = {}
        for path in folder.glob(GENERATION.format("*")):
            with suppress(DamagedStateError):
                if kept := read_contents(path):
                    self._kept[actor][kept.generation] = kept
        names = [path.name for path in folder.iterdir()]
        numbers = [int(n) for name in names if (n := name.rpartition(".")[2]).isdecimal()]
        self._last_file[actor] = max(numbers, default=0)
        self._remove_unused(actor, names)

    def _remove_unused(self, actor: str, files: Iterable[str]) -> None:
        """Remove those of the files that neither the state nor a generation of it needs.

        If that fails, the next process removes them.
        """
        kept = self._kept[actor]
        used = {CONTENTS, *map(list_name, kept)}
        if writing := self._writing.get(actor):
            used.update(writing.sources.values())
        for contents in (self._contents[actor], *kept.values()):
            used.update(contents.files.values())
        for file in sorted(set(files) - used):
            _remove(self.folder / actor / file)

    # --- older generations ------------------------------------------------------------------------
    def keep(
        self, actor: str, generation: int, completed: int, unsynced: Iterable[Path] = ()
    ) -> GenerationFiles:
        """Keep the last saved state as a generation; delete older ones except `completed`.

        Args:
            actor: Name of the actor.
            generation: Number of the new generation, which no earlier generation has.
            completed: Number of the newest generation that all actors have completed.
            unsynced: Files that were given to `save` and are not synced to the disk yet. The caller
                must sync them.

        Returns:
            The files of the generation. They are complete on disk after a call of
            `GenerationFiles.write`.

        Raises:
            OSError: A file cannot be read.
            DataError: Another version of the service wrote the state.
        """
        folder = self.folder / actor
        if actor not in self._saved and folder.is_dir():
            self._open(actor)
        now = self._contents.get(actor, StateContents({}))
        if not now.files:
            return GenerationFiles(folder)
        paths = self._relative(unsynced)
        if now.unsynced != paths:
            self._write_contents(actor, msgspec.structs.replace(now, unsynced=paths))
        kept = self._kept[actor]
        old = [n for n in kept if n != completed]
        unused = [file for n in old for file in (*kept.pop(n).files.values(), list_name(n))]
        checks = now.checks or {
            p: check_of((folder / f).read_bytes()) for p, f in now.files.items()
        }
        copies = self._copies.get(actor, {})
        safe = set(kept[completed].files.values()) if completed in kept else set()
        files = {part: copies.get(file, "") for part, file in now.files.items()}
        sources = {part: now.files[part] for part, copy in files.items() if copy not in safe}
        files.update((part, self._new_file(actor, part)) for part in sources)
        self._copies[actor] = {now.files[part]: copy for part, copy in files.items()}
        kept[generation] = StateContents(files, checks=checks, generation=generation)
        new = GenerationFiles(folder, list_name(generation), kept[generation], sources)
        past, self._writing[actor] = self._writing.get(actor), new
        self._remove_unused(actor, [*unused, *(past.sources.values() if past else ())])
        return new

    def give_up(self, actor: str) -> None:
        """Delete all older copies (generations) of an actor's state, but not its newest state.

        Raises:
            OSError: The disk cannot be written.
        """
        folder = self.folder / actor
        if writing := self._writing.get(actor):
            writing.is_given_up = True
        for path in folder.glob(GENERATION.format("*")):
            path.unlink(missing_ok=True)
        if folder.is_dir():
            sync(folder)  # The actor may now remove files that only the generations need.
        copies = {f for kept in self._kept.get(actor, {}).values() for f in kept.files.values()}
        copies.update(writing.sources.values() if writing else ())
        for known in (self._copies, self._writing):
            known.pop(actor, None)
        if actor in self._kept:
            self._kept[actor] = {}
            self._remove_unused(actor, copies)

    def exists(self, actor: str, generation: int = NEWEST) -> bool:
        """Return whether an actor has a state in a generation, or a newest state for NEWEST."""
        return (self.folder / actor / list_name(generation)).exists()

    def is_kept(self, actor: str) -> bool:
        """Return whether an older copy (generation) of the actor's state exists."""
        if actor in self._kept:
            return bool(self._kept[actor])
        return any((self.folder / actor).glob(GENERATION.format("*")))

    def fall_back(self, actor: str, generation: int) -> None:
        """Replace the newest state of an actor by its state in a generation (older copy).

        If the actor has no state in the generation, the newest state is deleted.

        Raises:
            OSError: The state cannot be written.
        """
        folder = self.folder / actor
        self._forget(actor)
        contents = read_contents(folder / list_name(generation))
        if contents is None:
            (folder / CONTENTS).unlink(missing_ok=True)
            if folder.exists():
                sync(folder)
        else:
            write_atomically(folder / CONTENTS, contents.encode(), syncs=True)

    def has_fallen_back(self, actor: str) -> bool:
        """Return whether the last loaded state of an actor is an older copy (generation)."""
        return actor in self._fallen_back


def list_name(generation: int) -> str:
    """Return the name of the file that lists the files of a state."""
    return GENERATION.format(generation) if generation else CONTENTS


def _remove(file: Path) -> None:
    with suppress(OSError):
        file.unlink()
