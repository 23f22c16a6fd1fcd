"""What came of a topic, by the numbers that its producer gave."""

from .links import Header

MOST_MISSING = 1024  # numbers that may come late yet: half a minute of a camera


class Numbers:
    """How many never came. One that comes late after all is none of them, one that comes again
    neither: a producer that was started again repeats what some consumer may not have had."""

    def __init__(self) -> None:
        self.lost = 0
        self._producer: tuple[str, int] = ("", 0)  # name and epoch of who sent the last one
        self._next = 0  # number of that producer
        self._missing: dict[int, None] = {}  # in order

    def came(self, header: Header) -> bool:
        """Take note of a message; False: it came before."""
        if (header.source, header.epoch) != self._producer:
            self._producer, self._next = (header.source, header.epoch), header.seq
            self._missing.clear()
        if header.seq < self._next:
            return self._came_late(header.seq)
        self.lost += header.seq - self._next
        missed = range(max(self._next, header.seq - MOST_MISSING), header.seq)
        self._missing |= dict.fromkeys(missed)
        while len(self._missing) > MOST_MISSING:
            del self._missing[next(iter(self._missing))]
        self._next = header.seq + 1
        return True

    def _came_late(self, seq: int) -> bool:
        if seq not in self._missing:
            return False
        del self._missing[seq]
        self.lost -= 1
        return True
