"""MCAP files of a recording: written message by message, and indexed for reading.

Records are not chunked: writing costs a fifth, and a file that was cut off by a kill or a full disk
is good up to its last whole record. Unlike the readers of the library, the index takes such a file,
needs no summary, and leaves bodies on the disk until they are asked for.
Format: https://mcap.dev/spec
"""

import logging
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

RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the body

MAX_CHUNK_BYTES = 1 << 28  # ours have none; other tools fill them to 1 or 4 MB
UNREADABLE = (
    *(OSError, struct.error, McapError, ZstdError, ValueError, LookupError),
    *(MemoryError, OverflowError),  # a damaged length asks for too much
)

ABOUT = "ldo/recording"  # name of the metadata record
# Version of the messages, states and journal entries in a recording, a field of that record. A
# change after which an older recording no longer replays increments it. Version 1 had no number.
RECORDING_VERSION = 2
CHECK_EVERY_BYTES = 64_000_000  # limits are looked at so often: 10 ms of a fast disk


@dataclass(frozen=True, slots=True)
class MessageLocation:
    """A message: the file's bytes [start, start + size), or those of a chunk in it."""

    topic: str
    number: int
    stamp_ns: int
    start: int
    size: int
    chunk: int | None  # where the chunk's record starts


@dataclass
class McapIndex:
    """Raises DataError for a file that is no MCAP."""

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    places: list[MessageLocation] = field(default_factory=list)  # in the order of the file
    is_whole: bool = False  # it was finished: neither killed nor cut off

    def __post_init__(self) -> None:
        self._topics: dict[int, str] = {}
        self._chunk: tuple[int, bytes] = (-1, b"")  # the one read last
        try:
            with self.path.open("rb") as file:
                self._read_index(file, self.path.stat().st_size)
        except UNREADABLE as error:
            raise DataError(f"{self.path} cannot be read as a recording: {error}.") from error

    def body(self, place: MessageLocation) -> bytes:
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
            raise ValueError("it is no MCAP file")
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
            self.places.append(place)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(record))
            self._topics[channel.id] = channel.topic
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(ReadDataStream(record))
            self.metadata[metadata.name] = metadata.metadata


def require_version(index: McapIndex) -> None:
    """Raise DataError if a recording has another version than this service replays."""
    version = index.metadata.get(ABOUT, {}).get("version", "1")
    if version != str(RECORDING_VERSION):
        raise DataError(
            f"{index.path} has version={version}, and this service replays {RECORDING_VERSION}: "
            "another version of the service recorded it. Replay it with that version; its camera "
            "frames remain a SOURCE of `ldo run`."
        )


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, place and length of every whole record; the stream is at its content."""
    while size - stream.tell() >= RECORD.size:
        opcode, length = RECORD.unpack(stream.read(RECORD.size))
        start = stream.tell()
        if start + length > size:
            return
        yield opcode, start, length
        stream.seek(start + length)


def _read_chunk(file: BinaryIO) -> bytes:
    """The uncompressed data of the chunk whose content begins here."""
    chunk = Chunk.read(ReadDataStream(file))
    announced = frame_content_size(chunk.data) if chunk.compression == "zstd" else 0
    if max(announced, chunk.uncompressed_size) > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk says that it unpacks to over {MAX_CHUNK_BYTES} bytes")
    data, length = get_chunk_data_stream(chunk)
    return data.read(length)


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """What a recording may cost. 640x480 at 30 Hz makes 100 MB a second."""

    max_gb: float = 50.0  # of the whole folder; more is not recorded
    min_free_gb: float = 1.0  # left on the disk for everything else, such as the actors' states
    queue_mb: float = 256.0  # per actor, in memory: 2 s of frames when the disk is busy elsewhere

    def __post_init__(self) -> None:
        if self.max_gb <= 0 or self.queue_mb <= 0 or self.min_free_gb < 0:
            raise ConfigError(
                named(self, "max_gb", "min_free_gb", "queue_mb") + ": sizes must be positive."
            )


class RecordingFile:
    """Opened new, written by one thread. After an error, or at a limit, it takes nothing more."""

    def __init__(self, path: Path, about: Mapping[str, str], config: RecordConfig) -> None:
        """Raises OSError when the file exists or cannot be written."""
        self.path, self._config = path, config
        self._file: BinaryIO = path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.NONE, use_chunking=False)
        self._writer.start(profile="ldo", library="ldo-slam")
        self._writer.add_metadata(ABOUT, {**about, "version": str(RECORDING_VERSION)})
        self._file.flush()
        self._channels: dict[str, int] = {}
        self._log_ns = 0  # of the last record
        self._unchecked = 0
        self.is_open = True

    def add_entry(self, entry: Entry) -> None:
        body = msgspec.msgpack.encode(entry)
        self.add(CHANNELS[type(entry)], type(entry), body, entry.step, time.time_ns())

    def add(
        self, topic: str, kind: type, body: bytes | memoryview, number: int, stamp_ns: int
    ) -> None:
        """Append a message of type `kind`; its publish time is `stamp_ns`."""
        if not self.is_open:
            return
        data = cast(bytes, body)  # a view is written without a copy
        try:
            self._log_ns = max(time.time_ns(), self._log_ns + 1)  # tools sort by it
            self._writer.add_message(
                self._channel(topic, kind), self._log_ns, data, stamp_ns, number
            )
            self._file.flush()
        except OSError as error:
            self._give_up(error)
        self._unchecked += len(body)

    def _channel(self, topic: str, kind: type) -> int:
        if topic not in self._channels:
            schema = msgspec.json.encode(msgspec.json.schema(kind))
            schema_id = self._writer.register_schema(kind.__name__, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id)
        return self._channels[topic]

    def is_over_limit(self) -> bool:
        """Whether the folder has grown too large, or the disk too full."""
        if self._unchecked < CHECK_EVERY_BYTES:
            return False
        self._unchecked = 0
        folder = self.path.parent
        used = sum(file.stat().st_size for file in folder.glob("*.mcap"))
        free = shutil.disk_usage(folder).free
        return used > self._config.max_gb * 1e9 or free < self._config.min_free_gb * 1e9

    def close(self) -> None:
        """Write the summary, which lets tools open the file at once."""
        if not self.is_open:
            return
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self._give_up(error)
        self.is_open = False

    def _give_up(self, error: OSError) -> None:
        """What was written before stays readable. The robot goes on."""
        log.error("%s: %s: this recording ends here", self.path, error.strerror)
        self.abandon()

    def abandon(self) -> None:
        """Take nothing more, and leave the end as it is."""
        self.is_open = False
        with suppress(OSError):  # what it could not flush
            self._file.close()
