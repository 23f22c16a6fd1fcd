"""What is fuzzed: something that reads bytes of strangers, and what it may answer."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ldo_service.errors import LdoError

Read = Callable[[bytes, Path], object]


@dataclass(frozen=True, slots=True)
class Target:
    """`read` takes bytes, and a folder that is its own, where it may leave files for the reader.

    seeds    what is valid, and is changed a little
    refuses  how bytes may be refused; whatever else is raised is a mistake of ours
    """

    name: str
    read: Read
    seeds: Sequence[bytes]
    refuses: tuple[type[Exception], ...] = (LdoError,)

    def __str__(self) -> str:
        return self.name

    def attempt(self, body: bytes, folder: Path) -> None:
        """Raises what is no refusal."""
        with suppress(*self.refuses):
            self.read(body, folder)


def as_file(name: str, read: Callable[[Path], object]) -> Read:
    """Reads a file of that name."""

    def written(body: bytes, folder: Path) -> object:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(body)
        return read(path)

    return written


def in_folder(name: str, read: Callable[[Path], object], others: dict[str, bytes]) -> Read:
    """Reads a folder with that file beside others, which are good."""

    def written(body: bytes, folder: Path) -> object:
        for other, good in {**others, name: body}.items():
            path = folder / other
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists() or other == name:
                path.write_bytes(good)
        return read(folder)

    return written


def chosen(*reads: Callable[[bytes], object]) -> Read:
    """The first byte says which of them reads the rest."""

    def first(body: bytes, _folder: Path) -> object:
        return reads[body[0] % len(reads)](body[1:]) if body else None

    return first


def numbered(bodies: Iterable[bytes]) -> list[bytes]:
    """Seeds for `chosen`, one for each reader."""
    return [bytes([number]) + body for number, body in enumerate(bodies)]
