"""MCAP files of a recording: written message by message, and indexed for reading.

Records are not grouped into chunks, because writing chunks takes five times as long. If a killed
process or a full disk cuts off a file, the file is readable up to its last whole record.
`McapIndex` accepts such a file, unlike the readers of the library `mcap`. The index does not need
the summary at the end of the file, and reads message bodies from the disk only on request.
Format: https://mcap.dev/spec
"""

import logging
import os
import shutil
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, cast

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError, frame_content_size

from ldo_service.errors import ConfigError, DataError, named
from ldo_service.runtime.journal import CHANNELS, Entry

log = logging.getLogger(__name__)

RECORD = struct.Struct("<BQ")  # Opcode, length of the content.
MESSAGE = struct.Struct("<HIQQ")  # Channel, sequence, log time, publish time; the body follows.

# Maximum size of a chunk that is read. This service writes no chunks; other tools write chunks of 1
# or 4 MB.
MAX_CHUNK_BYTES = 1 << 28
UNREADABLE = (
    *(OSError, struct.error, McapError, ZstdError, ValueError, LookupError),
    *(MemoryError, OverflowError),  # Raised if a length in a damaged file is too large.
)

FILES_SUFFIX = ".files"  # Suffix of the folder with the files of an actor.
ABOUT = "ldo/recording"  # Name of the metadata record.
# Version of the messages, states and journal entries in a recording. It is a field of the metadata;
# recordings of version 1 lack the field. Increment the version with every change after which older
# recordings can no longer be replayed.
RECORDING_VERSION = 3
# Bytes written between two checks of the limits; a fast disk writes them in 10 ms.
CHECK_EVERY_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class MessageLocation:
    """Location of a message body: bytes [start, start + size) of the file or of a chunk in it."""

    topic: str  # Name of the topic, or channel of a journal entry.
    number: int  # Sequence number in the MCAP file.
    stamp_ns: int  # MCAP publish time: the stamp of the message.
    start: int  # Position of the body, bytes.
    size: int  # Size of the body, bytes.
    chunk: int | None  # Offset of the chunk in the file; None if the message is not in a chunk.


@dataclass
class McapIndex:
    """Index of the messages in an MCAP file."""

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # Metadata records, by name.
    # Locations of the messages, sorted by position in the file.
    locations: list[MessageLocation] = field(default_factory=list)
    is_whole: bool = False  # True if the file was closed and not cut off.

    def __post_init__(self) -> None:
        """Read the index.

        Raises:
            DataError: The file is not a readable MCAP file.
        """
        self._topics: dict[int, str] = {}
        self._chunk: tuple[int, bytes] = (-1, b"")  # Offset and data of the last chunk read.
        try:
            with self.path.open("rb") as file:
                self._read_index(file, self.path.stat().st_size)
        except UNREADABLE as error:
            raise DataError(
                f"{self.path} cannot be read as a recording: {error}. Give an MCAP file that "
                "`ldo record` wrote."
            ) from error

    def body(self, place: MessageLocation) -> bytes:
        """Read the encoded body of a message."""
        with self.path.open("rb") as file:
            if place.chunk is None:
                file.seek(place.start)
                return file.read(place.size)
            if self._chunk[0] != place.chunk:
                file.seek(place.chunk)
                self._chunk = (place.chunk, _read_chunk(file))
        return self._chunk[1][place.start : place.start + place.size]

    def _read_index(self, file: BinaryIO, size: int) -> None:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise ValueError("the file is not an MCAP file")
        for opcode, start, length in _records(file, size):
            if opcode == Opcode.CHUNK:
                data = _read_chunk(file)
                for inner, at, inner_length in _records(BytesIO(data), len(data)):
                    self._note(
                        inner, BytesIO(data[at : at + inner_length]), at, inner_length, start
                    )
            elif opcode == Opcode.FOOTER:
                self.is_whole = True
            else:
                self._note(opcode, file, start, length, None)

    def _note(
        self, opcode: int, record: BinaryIO, start: int, length: int, chunk: int | None
    ) -> None:
        if opcode == Opcode.MESSAGE:
            channel, number, _, stamp_ns = MESSAGE.unpack(record.read(MESSAGE.size))
            start, length = start + MESSAGE.size, length - MESSAGE.size
            place = MessageLocation(self._topics[channel], number, stamp_ns, start, length, chunk)
            self.locations.append(place)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(record))
            self._topics[channel.id] = channel.topic
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(ReadDataStream(record))
            self.metadata[metadata.name] = metadata.metadata


def require_version(index: McapIndex) -> None:
    """Check that a recording has the version that this service replays, `RECORDING_VERSION`.

    Raises:
        DataError: The recording has another version.
    """
    version = index.metadata.get(ABOUT, {}).get("version", "1")
    if version != str(RECORDING_VERSION):
        raise DataError(
            f"{index.path} has recording version {version}, but this service replays only version "
            f"{RECORDING_VERSION}. Replay the file with the version of the service that recorded "
            "it, or give it to `ldo run` as SOURCE to use its camera frames."
        )


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, content offset and content length of each whole record in a stream.

    At each yield, the position of the stream is the start of the record's content.
    """
    while size - stream.tell() >= RECORD.size:
        opcode, length = RECORD.unpack(stream.read(RECORD.size))
        start = stream.tell()
        if start + length > size:
            return
        yield opcode, start, length
        stream.seek(start + length)


def _read_chunk(file: BinaryIO) -> bytes:
    """Read and decompress the chunk at the current position of the file."""
    chunk = Chunk.read(ReadDataStream(file))
    announced = frame_content_size(chunk.data) if chunk.compression == "zstd" else 0
    if (size := max(announced, chunk.uncompressed_size)) > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk has {size} bytes, more than the maximum of {MAX_CHUNK_BYTES}")
    data, length = get_chunk_data_stream(chunk)
    return data.read(length)


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """Limits of a recording, which grows by 100 MB/s with a camera of 640x480 at 30 Hz."""

    max_gb: float = 50.0  # Size of the recording's folder at which recording stops.
    # Free disk space below which recording stops, for other files such as the actors' states.
    min_free_gb: float = 1.0
    # Maximum size of each actor's queue in memory. It holds 2 s of frames while the disk is busy.
    queue_mb: float = 256.0

    def __post_init__(self) -> None:
        if self.max_gb <= 0 or self.queue_mb <= 0 or self.min_free_gb < 0:
            raise ConfigError(
                named(self, "max_gb", "min_free_gb", "queue_mb")
                + " must be positive; min_free_gb may be 0."
            )


def recording_bytes(folder: Path) -> int:
    """Return the size of a recording in bytes, with its MCAP files and the files of its actors."""
    total = 0
    for name in (path for path in folder.iterdir() if path.suffix in (".mcap", FILES_SUFFIX)):
        for file in os.scandir(name) if name.is_dir() else (name,):
            with suppress(FileNotFoundError):  # A file was renamed to its final name meanwhile.
                total += file.stat().st_size
    return total


class RecordingFile:
    """New MCAP file, which only one thread may write.

    After an error, or when a limit is reached, the file is closed and further messages are ignored.
    """

    def __init__(self, path: Path, about: Mapping[str, str], config: RecordConfig) -> None:
        """Create the file.

        Args:
            path: The new file.
            about: Fields of the metadata record.
            config: Limits of the recording.

        Raises:
            OSError: The file exists or cannot be written.
        """
        self.path, self._config = path, config
        self._file: BinaryIO = path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.NONE, use_chunking=False)
        self._writer.start(profile="ldo", library="ldo-slam")
        self._writer.add_metadata(ABOUT, {**about, "version": str(RECORDING_VERSION)})
        self._file.flush()
        self._channels: dict[str, int] = {}
        self._log_ns = 0  # Log time of the last record.
        self._unchecked = 0  # Bytes written since the last check of the limits.
        self._written = 0  # Bytes written by this object.
        self._used = recording_bytes(path.parent)  # Size of the folder at the last check, bytes.
        self.is_open = True

    def add_entry(self, entry: Entry) -> None:
        """Append a journal entry."""
        body = msgspec.msgpack.encode(entry)
        self.add(CHANNELS[type(entry)], type(entry), body, entry.step, time.time_ns())

    def add(
        self, topic: str, kind: type, body: bytes | memoryview, number: int, stamp_ns: int
    ) -> None:
        """Append an encoded message.

        Args:
            topic: Topic of the message.
            kind: Type of the message.
            body: Encoded message.
            number: Sequence number of the message in the file.
            stamp_ns: Stamp of the message, which becomes the MCAP publish time.
        """
        if not self.is_open:
            return
        data = cast(bytes, body)  # A memoryview is written without a copy.
        try:
            self._log_ns = max(time.time_ns(), self._log_ns + 1)  # Tools sort by log time.
            self._writer.add_message(
                self._channel(topic, kind), self._log_ns, data, stamp_ns, number
            )
            self._file.flush()
        except OSError as error:
            self._give_up(error)
        self._unchecked += len(body)
        self._written += len(body)

    def _channel(self, topic: str, kind: type) -> int:
        if topic not in self._channels:
            schema = msgspec.json.encode(msgspec.json.schema(kind))
            schema_id = self._writer.register_schema(kind.__name__, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id)
        return self._channels[topic]

    def is_over_limit(self) -> bool:
        """Return whether the folder exceeds `max_gb`, or less than `min_free_gb` of disk is free.

        The sizes are checked each time `CHECK_EVERY_BYTES` have been written. Between two checks,
        the result is False.
        """
        if self._unchecked < CHECK_EVERY_BYTES:
            return False
        self._unchecked = 0
        folder = self.path.parent
        self._used = recording_bytes(folder)
        free = shutil.disk_usage(folder).free
        return self._used > self._config.max_gb * 1e9 or free < self._config.min_free_gb * 1e9

    def metrics(self) -> dict[str, float]:
        """Return sizes and limits of the recording in MB, or an empty dict if the file is closed.

        `recording_mb` is the size of the folder at the last check, plus the messages that were
        written to this file since.
        """
        if not self.is_open:
            return {}
        metrics = {
            "recording_file_mb": self._written / 1e6,
            "recording_mb": (self._used + self._unchecked) / 1e6,
            "recording_max_mb": 1e3 * self._config.max_gb,
            "recording_min_free_mb": 1e3 * self._config.min_free_gb,
        }
        with suppress(OSError):  # The folder was removed.
            metrics["recording_free_mb"] = shutil.disk_usage(self.path.parent).free / 1e6
        return metrics

    def close(self) -> None:
        """Write the summary and close the file.

        The summary lets other tools open the file without reading all of it.
        """
        if not self.is_open:
            return
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self._give_up(error)
        self.is_open = False

    def _give_up(self, error: OSError) -> None:
        """End the recording after an error; the records before it stay readable."""
        log.error("%s: writing failed (%s). This recording ends here; the robot continues. Check "
                  "the disk before the next recording.", self.path, error.strerror)  # fmt: skip
        self.abandon()

    def abandon(self) -> None:
        """Close the file without a summary and ignore further messages."""
        self.is_open = False
        with suppress(OSError):  # Closing flushes the file, which may fail.
            self._file.close()
