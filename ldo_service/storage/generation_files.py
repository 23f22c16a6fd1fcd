"""Copies of the files of an actor's state for a generation.

A generation is a synced copy of the states of all actors. The service falls back to a generation if
the current states are damaged; see `runtime.generations`.
"""

from dataclasses import dataclass, field
from pathlib import Path

from ldo_service.errors import DamagedStateError

from .atomic_write import sync, write_atomically
from .state_contents import StateContents, check_of


@dataclass
class GenerationFiles:
    """Files that a generation adds to the disk for one actor; any thread may call `write`.

    A generation is a copy of the saved states of all actors, to which the service can fall back.
    The generation has its own files, so damage to a file of the current state does not affect the
    generation. A part that did not change since the last complete generation is not copied again.
    """

    folder: Path  # Folder of the actor's state.
    list_name: str = ""  # Name of the list of the files; empty if the actor has no state.
    # List of the files of the generation.
    contents: StateContents = field(default_factory=lambda: StateContents({}))
    sources: dict[str, str] = field(default_factory=dict)  # File to copy, by part.
    is_written: bool = False  # True once `write` has succeeded.
    is_given_up: bool = False  # True if the generation is not needed any more.

    def write(self) -> None:
        """Copy the files, write their list, and sync both.

        Raises:
            DamagedStateError: A file does not match its checksum.
            OSError: A file cannot be read or written, or the generation is not needed any more.
        """
        if not self.list_name:
            return
        for part, source in self.sources.items():
            self._refuse_if_given_up()
            body = (self.folder / source).read_bytes()
            if check_of(body) != self.contents.checks[part]:
                raise DamagedStateError(
                    f"{self.folder / source} is damaged: its {len(body)} bytes do not match their "
                    "checksum"
                )
            copy = self.folder / self.contents.files[part]
            copy.write_bytes(body)
            sync(copy)
        write_atomically(self.folder / self.list_name, self.contents.encode(), syncs=True)
        self._refuse_if_given_up()
        self.is_written = True

    def _refuse_if_given_up(self) -> None:
        """Remove all written files and raise an OSError if the generation was given up."""
        if self.is_given_up:
            for file in (self.list_name, *(self.contents.files[part] for part in self.sources)):
                (self.folder / file).unlink(missing_ok=True)
            raise OSError(
                f"{self.folder / self.list_name} was not written, because the generation is not "
                "needed any more"
            )
