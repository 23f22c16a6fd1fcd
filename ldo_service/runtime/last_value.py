"""Last value of a state topic, kept to answer the queries of late subscribers."""

from ldo_service.schemas import Message


class LastValue:
    """Last complete value of a topic; a value may consist of several messages."""

    def __init__(self) -> None:
        self._incomplete: list[tuple[bytes, bytes]] = []
        # Header and body of each part of the last complete value.
        self.parts: tuple[tuple[bytes, bytes], ...] = ()

    def add(self, message: Message, header: bytes, body: bytes) -> None:
        """Add one message of a new value; the complete new value replaces the last value."""
        if getattr(message, "part", 0) == 0:
            self._incomplete.clear()
        self._incomplete.append((header, body))
        if len(self._incomplete) == getattr(message, "parts", 1):
            self.parts = tuple(self._incomplete)

    def clear(self) -> None:
        """Delete the value."""
        self._incomplete.clear()
        self.parts = ()
