"""Files to which the saved state of a map refers: offloaded Gaussians and keyframe images."""

from pathlib import Path

from .keyframe_store import KeyframeStore
from .offloading import OffloadedGaussians


class MapFiles:
    """Files of a map, which are removed only when no saved state of the map needs them.

    The checkpointer calls `saved` or `kept` after it has saved the state, and the other methods
    while it writes the files to the disk.
    """

    def __init__(self, offloaded: OffloadedGaussians, images: KeyframeStore) -> None:
        self._offloaded = offloaded
        self._folders = offloaded.files, images.files

    def saved(self) -> None:
        """Remove files that the last snapshot does not need; call it after saving that snapshot."""
        self._offloaded.retired.saved()

    def kept(self, *, is_previous_complete: bool) -> None:
        """Remove files that no kept generation (older version) of the saved state needs.

        Args:
            is_previous_complete: See `RetiredFiles.kept`.
        """
        self._offloaded.retired.kept(is_previous_complete=is_previous_complete)

    def retired_bytes(self) -> int:
        """Return the size, in bytes, of the files that only older saved states need."""
        return self._offloaded.retired.size_bytes

    def unsynced_files(self) -> list[Path]:
        """Return the files that may not be on the disk yet; see `ChecksummedFolder`."""
        return [path for folder in self._folders for path in folder.unsynced_files()]

    def begin_sync(self) -> None:
        """Record that the caller begins to sync `unsynced_files`."""
        for folder in self._folders:
            folder.begin_sync()

    def end_sync(self) -> None:
        """Record that the files of the last `begin_sync` are on the disk."""
        for folder in self._folders:
            folder.end_sync()
