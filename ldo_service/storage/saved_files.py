"""Check and sync of the files of a saved state when the service starts or stops."""

import msgspec

from ldo_service.errors import DamagedStateError, DataError

from .atomic_write import sync_all, with_folders, write_atomically
from .checksummed_folder import read_checked
from .state_contents import read_contents
from .state_store import CONTENTS, NEWEST, FolderStore, list_name


class SavedFiles:
    """Files of the saved state of one actor; the actor must not run during any call."""

    def __init__(self, store: FolderStore, actor: str) -> None:
        """Initialize without reading any file.

        Args:
            store: Store of the states of all actors.
            actor: Name of the actor.
        """
        self._actor, self._folder = actor, store.folder / actor
        self._root = store.folder.parent  # Paths of unsynced files are relative to this folder.
        self._backlog = store.backlog_folder(actor)

    def check_unsynced(self, generation: int = NEWEST) -> None:
        """Check the files that were possibly not synced to the disk when the state was saved.

        These files are outside the folder of the state. A power cut may have damaged them.

        Args:
            generation: Number of the generation (older copy of the states) whose files are checked.
                By default, the files of the state after the last step are checked.

        Raises:
            DamagedStateError: A file is missing or damaged.
        """
        contents = read_contents(self._folder / list_name(generation))
        for file in contents.unsynced if contents else ():
            try:
                read_checked(self._root / file)
            except (DataError, OSError) as error:
                raise DamagedStateError(
                    f"the state of {self._actor} in {self._folder} is damaged: {error}"
                ) from error

    def sync_unsynced(self) -> None:
        """Sync the files that `check_unsynced` checks, and empty the list of these files.

        If the actor removes one of these files afterwards, the file does not count as missing.

        Raises:
            OSError: The disk is full, or a file cannot be read.
        """
        path = self._folder / CONTENTS
        contents = read_contents(path)
        if contents and contents.unsynced:
            sync_all(with_folders([self._root / file for file in contents.unsynced]))
            synced = msgspec.structs.replace(contents, unsynced=())
            write_atomically(path, synced.encode(), syncs=True)

    def sync(self) -> None:
        """Sync the state after the last step, with all files that it needs.

        Raises:
            OSError: The disk is full, or a file cannot be read.
        """
        self.sync_unsynced()
        path = self._folder / CONTENTS
        if contents := read_contents(path):
            parts = [self._folder / file for file in contents.files.values()]
            sync_all(with_folders([*parts, path]))
        sync_all(with_folders(self._backlog.glob("*/*.log")))
