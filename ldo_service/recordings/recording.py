"""A recording as it is read: a folder with a file for each process that an actor lived in."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from ldo_service.errors import ConfigError, DataError
from ldo_service.runtime.journal import CHANNELS, Entry, StepRecord
from ldo_service.schemas import decode

from .mcap_file import ABOUT, McapIndex, MessageLocation, require_version

NAME = re.compile(r"(?P<actor>\w+?)(\.(?P<number>\d+))?\.mcap")
ENTRIES: Mapping[str, Any] = {channel: kind for kind, channel in CHANNELS.items()}


class JournalFile:
    """What an actor lived in one process. Raises DataError when it cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._index = McapIndex(path)
        self._entries = [place for place in self._index.places if place.topic in ENTRIES]
        self.messages = [place for place in self._index.places if place.topic not in ENTRIES]
        self._by_number = {place.number: place for place in self.messages}

    @property
    def about(self) -> Mapping[str, str]:
        """Actor, robot, configuration, instruction set, versions."""
        return self._index.metadata.get(ABOUT, {})

    def require_version(self) -> None:
        """Raise DataError if another version recorded what this service cannot replay."""
        require_version(self._index)

    @property
    def is_whole(self) -> bool:
        """It was closed in peace."""
        return self._index.is_whole

    @property
    def steps(self) -> int:
        return sum(place.topic == CHANNELS[StepRecord] for place in self._entries)

    def entries(self) -> Iterator[Entry]:
        for place in self._entries:
            try:
                yield decode(self._index.body(place), ENTRIES[place.topic])
            except msgspec.DecodeError as error:
                raise DataError(f"{self.path}, {place.topic} {place.number}: {error}.") from error

    def body(self, message: MessageLocation) -> bytes:
        return self._index.body(message)

    def taken(self, step: StepRecord) -> bytes:
        """The message of a step."""
        if step.taken not in self._by_number:
            raise DataError(f"{self.path}: the message of step {step.step} is missing.")
        return self.body(self._by_number[step.taken])


def recorded_actors(folder: Path) -> dict[str, list[Path]]:
    """By actor: its files, in the order of its lives."""
    return {actor: list(lives.values()) for actor, lives in sorted(_lives(folder).items())}


def new_path(folder: Path, actor: str) -> Path:
    """For the next life of an actor."""
    last = max(_lives(folder).get(actor, ()), default=0)
    return folder / (f"{actor}.{last + 1}.mcap" if last else f"{actor}.mcap")


def _lives(folder: Path) -> dict[str, dict[int, Path]]:
    """By actor, then by number from 1, ascending."""
    matches = [(NAME.fullmatch(path.name), path) for path in folder.glob("*.mcap")]
    numbered = sorted((int(m["number"] or 1), m["actor"], path) for m, path in matches if m)
    lives: dict[str, dict[int, Path]] = {}
    for number, actor, path in numbered:
        lives.setdefault(actor, {})[number] = path
    return lives


def prepare_recording(folder: Path) -> None:
    """A folder that holds nothing yet. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ConfigError(f"{folder} is not empty. Choose another folder for the recording.")
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror}.") from error
