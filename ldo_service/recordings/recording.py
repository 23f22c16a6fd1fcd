"""Reader of a recording: a folder with one file for each process of each actor."""

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
    """Recorded journal of an actor, from the start to the end of one process of the actor."""

    def __init__(self, path: Path) -> None:
        """Read the index of a file.

        Raises:
            DataError: The file cannot be read.
        """
        self.path = path
        self._index = McapIndex(path)
        self._entries = [place for place in self._index.locations if place.topic in ENTRIES]
        self.messages = [place for place in self._index.locations if place.topic not in ENTRIES]
        self._by_number = {place.number: place for place in self.messages}

    @property
    def about(self) -> Mapping[str, str]:
        """Metadata by name: actor, robot, configuration, instruction set, versions."""
        return self._index.metadata.get(ABOUT, {})

    def require_version(self) -> None:
        """Check that the file has the recording version that this service can replay.

        Raises:
            DataError: The file has another recording version.
        """
        require_version(self._index)

    @property
    def is_whole(self) -> bool:
        """True if the file was closed and not cut off."""
        return self._index.is_whole

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return sum(place.topic == CHANNELS[StepRecord] for place in self._entries)

    def entries(self) -> Iterator[Entry]:
        """Yield the journal entries in order.

        Raises:
            DataError: An entry is damaged.
        """
        for place in self._entries:
            try:
                yield decode(self._index.body(place), ENTRIES[place.topic])
            except msgspec.DecodeError as error:
                raise DataError(
                    f"{self.path}: entry {place.number} of {place.topic} is damaged: {error}. Copy "
                    "the recording again, or make a new one."
                ) from error

    def body(self, message: MessageLocation) -> bytes:
        """Read the encoded body of a message."""
        return self._index.body(message)

    def taken(self, step: StepRecord) -> bytes:
        """Read the encoded input message of a step.

        Raises:
            DataError: The message is missing.
        """
        if step.taken not in self._by_number:
            raise DataError(
                f"{self.path}: the input of step {step.step} is missing. Copy the recording "
                "again, or make a new one."
            )
        return self.body(self._by_number[step.taken])


def recorded_actors(folder: Path) -> dict[str, list[Path]]:
    """Return the files of each actor by name, in the order in which its processes started."""
    return {
        actor: list(files.values()) for actor, files in sorted(_files_by_process(folder).items())
    }


def new_path(folder: Path, actor: str) -> Path:
    """Return the path of the file for the next process of an actor."""
    last = max(_files_by_process(folder).get(actor, ()), default=0)
    return folder / (f"{actor}.{last + 1}.mcap" if last else f"{actor}.mcap")


def _files_by_process(folder: Path) -> dict[str, dict[int, Path]]:
    """Return the files by actor, and for each actor by the number of its process.

    The numbers start at 1 and are in ascending order.
    """
    matches = [(NAME.fullmatch(path.name), path) for path in folder.glob("*.mcap")]
    numbered = sorted((int(m["number"] or 1), m["actor"], path) for m, path in matches if m)
    files: dict[str, dict[int, Path]] = {}
    for number, actor, path in numbered:
        files.setdefault(actor, {})[number] = path
    return files


def prepare_recording(folder: Path) -> None:
    """Create the folder of a recording, or continue the recording in it.

    After a restart of the service, each of its processes writes a new file into the same folder.

    Raises:
        ConfigError: The folder contains other files and no recording, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not _files_by_process(folder):
            raise ConfigError(
                f"{folder} is not empty and holds no recording. Choose another folder for the "
                "recording."
            )
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be written: {error.strerror}. Choose another folder for the "
            "recording."
        ) from error
