"""Fuzz target: a reader of untrusted bytes and the errors that it may raise."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ldo_service.errors import LdoError

Read = Callable[[bytes, Path], object]


@dataclass(frozen=True, slots=True)
class Target:
    """Reader of untrusted bytes.

    Attributes:
        name: Name of the target.
        read: The reader; it gets the bytes and a folder of its own for files.
        seeds: Valid bytes, from which mutations are made.
        refuses: Errors that the reader may raise. Any other error is a bug.
    """

    name: str
    read: Read
    seeds: Sequence[bytes]
    refuses: tuple[type[Exception], ...] = (LdoError,)

    def __str__(self) -> str:
        return self.name

    def attempt(self, body: bytes, folder: Path) -> None:
        """Read `body` and raise any unexpected error."""
        with suppress(*self.refuses):
            self.read(body, folder)


def as_file(name: str, read: Callable[[Path], object]) -> Read:
    """Return a target function that writes the bytes to a file and reads it."""

    def write_and_read(body: bytes, folder: Path) -> object:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(body)
        return read(path)

    return write_and_read


def in_folder(name: str, read: Callable[[Path], object], others: dict[str, bytes]) -> Read:
    """Return a target function that reads a folder: its input as file `name`, and `others`."""

    def write_and_read(body: bytes, folder: Path) -> object:
        for other, good in {**others, name: body}.items():
            path = folder / other
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists() or other == name:
                path.write_bytes(good)
        return read(folder)

    return write_and_read


def chosen(*reads: Callable[[bytes], object]) -> Read:
    """Return a target function whose read_chosen byte selects the reader of the rest."""

    def read_chosen(body: bytes, _folder: Path) -> object:
        return reads[body[0] % len(reads)](body[1:]) if body else None

    return read_chosen


def numbered(bodies: Iterable[bytes]) -> list[bytes]:
    """Return seeds for `chosen`, one for each reader."""
    return [bytes([number]) + body for number, body in enumerate(bodies)]
