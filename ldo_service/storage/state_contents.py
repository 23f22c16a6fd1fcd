"""List of the files of a saved state, with size and checksum of each file."""

import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from ldo_service.errors import DamagedStateError, DataError

from .state_codec import decode_state

# Version of the content of the parts. Increment it when a change of any actor's state makes older
# states incompatible, and add a golden state (`tests/faults/golden_state.py`). States of version 1
# contain no version number.
STATE_VERSION = 4
# The state of version 3 has the same parts, but no sizes and checksums.
UNCHECKED_VERSION = 3


class StateContents(msgspec.Struct, frozen=True):
    """Files of one state, and their format version.

    The names and types of the fields `files` and `version` never change. An older version of the
    service can therefore read these fields and reject a newer state.
    """

    files: dict[str, str]  # File name of each part.
    version: int = STATE_VERSION  # Version of the content of the parts.
    checks: dict[str, tuple[int, int]] = {}  # Size in bytes and CRC-32 of the file of each part.
    # Number of the generation that these files belong to; 0 for a state saved after a step.
    generation: int = 0
    # Files outside the folder to which the parts refer, and which are possibly not synced to the
    # disk yet; their paths are relative to the parent of the folder of all states.
    unsynced: tuple[str, ...] = ()
    checksum: int = 0  # CRC-32 of the encoded contents with checksum 0.

    def encode(self) -> bytes:
        """Encode this list of files with its checksum, for the file on disk."""
        return msgspec.msgpack.encode(msgspec.structs.replace(self, checksum=self._checksum()))

    def _checksum(self) -> int:
        return zlib.crc32(msgspec.msgpack.encode(msgspec.structs.replace(self, checksum=0)))

    @property
    def has_damaged_version(self) -> bool:
        """True if the checksum shows that only the version number is damaged."""
        own = msgspec.structs.replace(self, version=STATE_VERSION)
        return self.version != STATE_VERSION and own._checksum() == self.checksum

    def read_part(self, folder: Path, part: str) -> Any:
        """Read a part of the state from its file, and check size and checksum of the file.

        Raises:
            FileNotFoundError: The file is missing.
            ValueError: The file is damaged, or its name is invalid.
            OSError: The file cannot be read.
        """
        body = (folder / self.files[part]).read_bytes()
        if self.version != UNCHECKED_VERSION and check_of(body) != self.checks.get(part):
            raise ValueError(
                f"the {len(body)} bytes of {self.files[part]} do not match their checksum"
            )
        return decode_state(body)


def check_of(body: bytes) -> tuple[int, int]:
    """Return size in bytes and CRC-32 of the content of a file."""
    return len(body), zlib.crc32(body)


def read_contents(path: Path) -> StateContents | None:
    """Read the list of the files of a state; return None if the list does not exist.

    Raises:
        DamagedStateError: The list is damaged.
        DataError: Another version of the service wrote the list.
        OSError: The list cannot be read.
    """
    try:
        body = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        contents = _decode(body)
    except ValueError as error:
        raise DamagedStateError(f"{path} is damaged: {error}") from error
    is_known = contents.version in (STATE_VERSION, UNCHECKED_VERSION)
    if not is_known and not contents.has_damaged_version:
        raise DataError(
            f"{path} has version={contents.version}, and this service reads "
            f"{UNCHECKED_VERSION} and {STATE_VERSION}: another version of the service wrote this "
            "state. Choose another folder with --state, or use the version that wrote it."
        )
    if contents.version != UNCHECKED_VERSION and contents.encode() != body:
        raise DamagedStateError(f"{path} is damaged: its {len(body)} bytes do not match their "
                                "checksum")  # fmt: skip
    return contents


def require_known_versions(folder: Path) -> None:
    """Check that no state, and no generation of a state, is of another version.

    Damaged lists of files are ignored, because `FolderStore.load` reports them.

    Args:
        folder: Folder of the states of all actors.

    Raises:
        DataError: Another version of the service wrote a state.
    """
    for path in sorted(folder.glob("*/*.msgpack")):
        with suppress(DamagedStateError, OSError):
            read_contents(path)


def _decode(body: bytes) -> StateContents:
    try:
        return msgspec.msgpack.decode(body, type=StateContents)
    except msgspec.ValidationError:
        # Format of version 1; an error if damaged.
        msgspec.msgpack.decode(body, type=dict[str, str])
        return StateContents({}, version=1)
