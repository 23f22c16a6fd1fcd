"""Files that only saved states need, and their removal once no saved state needs them."""

from ldo_service.storage.checksummed_folder import ChecksummedFolder


class RetiredFiles:
    """Files that the current state does not need any more, but that a saved state may need.

    A file is kept while the last saved state needs it. If the service keeps older saved states,
    called generations, a file is also kept while one of these generations needs it. The service
    restores an older generation if the last state is damaged. A file is given by its number in the
    folder.
    """

    def __init__(self, files: ChecksummedFolder) -> None:
        self._files = files
        self._new: list[int] = []  # Retired after the last snapshot.
        self._unsaved: list[int] = []  # The last snapshot does not need them.
        self._kept: list[int] = []  # The newest kept generation does not need them.

    def add(self, number: int) -> None:
        """Add a file, which is removed as soon as no saved state needs it.

        A file in a temporary folder is removed at once, because no restored process uses it.
        """
        if self._files.is_temporary:
            self._files.remove(number)
        else:
            self._new.append(number)

    def on_snapshot(self) -> None:
        """Record that a snapshot was taken; the snapshot needs none of the files added so far."""
        self._unsaved, self._new = [*self._unsaved, *self._new], []

    def restart(self, numbers: list[int]) -> None:
        """Replace all added files by the files that a restored state does not need.

        Args:
            numbers: Numbers of the files that the restored state does not need.
        """
        self._new, self._unsaved, self._kept = [], numbers, []

    @property
    def size_bytes(self) -> int:
        """Size, in bytes, of the files that the last snapshot does not need."""
        return sum(self._files.sizes.get(n, 0) for n in (*self._unsaved, *self._kept))

    def saved(self) -> None:
        """Remove the files that the last snapshot does not need.

        Call this method after that snapshot was saved. If older generations of the state are kept,
        call `kept` instead.
        """
        self._remove(self._kept)
        self._remove(self._unsaved)

    def kept(self, *, is_previous_complete: bool) -> None:
        """Remove the files that no kept generation (older version) of the saved state needs.

        If older generations are kept, call this method instead of `saved`. Call it after the state
        was saved as a new generation.

        Args:
            is_previous_complete: True if the generation before the new one is complete. No older
                generation is needed then.
        """
        if is_previous_complete:
            self._remove(self._kept)
        self._kept += self._unsaved
        self._unsaved = []

    def _remove(self, numbers: list[int]) -> None:
        for number in numbers:
            self._files.remove(number)
        numbers.clear()
