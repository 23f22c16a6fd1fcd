"""Files that only older states need, until no such state can be restored any more."""

from ldo_service.storage.checksummed_folder import ChecksummedFolder


class RetiredFiles:
    """Numbers of files that the current state does not need.

    A process restored from the last saved state may still need them. If the saved states are also
    kept as older generations, the service may fall back to these.
    """

    def __init__(self, files: ChecksummedFolder) -> None:
        self._files = files
        self._new: list[int] = []  # Retired after the last snapshot.
        self._unsaved: list[int] = []  # The last snapshot does not need them.
        self._kept: list[int] = []  # The newest kept generation does not need them.

    def add(self, number: int) -> None:
        """Retire a file, or remove it if a restored process cannot use the folder."""
        if self._files.is_temporary:
            self._files.remove(number)
        else:
            self._new.append(number)

    def on_snapshot(self) -> None:
        """Note that a snapshot of the state is taken, which needs none of the files."""
        self._unsaved, self._new = [*self._unsaved, *self._new], []

    def restart(self, numbers: list[int]) -> None:
        """Replace all retired files by those that a restored state does not need."""
        self._new, self._unsaved, self._kept = [], numbers, []

    @property
    def size_bytes(self) -> int:
        """Size of the files that the last snapshot does not need, bytes."""
        return sum(self._files.sizes.get(n, 0) for n in (*self._unsaved, *self._kept))

    def saved(self) -> None:
        """Remove the files that the last snapshot does not need.

        Call this method once that snapshot is saved, if no older states are kept.
        """
        self._remove(self._kept)
        self._remove(self._unsaved)

    def kept(self, *, is_previous_complete: bool) -> None:
        """Remove the files that the kept generations do not need.

        Call this method instead of `saved` after each kept generation of the saved state.

        Args:
            is_previous_complete: Whether the generation kept before this one is complete, so that
                no older one is needed.
        """
        if is_previous_complete:
            self._remove(self._kept)
        self._kept += self._unsaved
        self._unsaved = []

    def _remove(self, numbers: list[int]) -> None:
        for number in numbers:
            self._files.remove(number)
        numbers.clear()
