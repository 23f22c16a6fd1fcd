"""Where the messages of an MCAP file lie.

Unlike the readers of the library this one takes a file that was cut off, needs no summary, and
leaves bodies on the disk until they are asked for. Format: https://mcap.dev/spec
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError, frame_content_size

from ldo_service.errors import DataError

RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the body

LARGEST_CHUNK_BYTES = 1 << 28  # ours have none; other tools fill them to 1 or 4 MB
UNREADABLE = (
    *(OSError, struct.error, McapError, ZstdError, ValueError, LookupError),
    *(MemoryError, OverflowError),  # a damaged length asks for too much
)


@dataclass(frozen=True, slots=True)
class Place:
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
    places: list[Place] = field(default_factory=list)  # in the order of the file
    is_whole: bool = False  # it was finished: neither killed nor cut off

    def __post_init__(self) -> None:
        self._topics: dict[int, str] = {}
        self._chunk: tuple[int, bytes] = (-1, b"")  # the one read last
        try:
            with self.path.open("rb") as file:
                self._read_index(file, self.path.stat().st_size)
        except UNREADABLE as error:
            raise DataError(f"{self.path} cannot be read as a recording: {error}.") from error

    def body(self, place: Place) -> bytes:
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
            place = Place(self._topics[channel], number, stamp_ns, start, length, chunk)
            self.places.append(place)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(record))
            self._topics[channel.id] = channel.topic
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(ReadDataStream(record))
            self.metadata[metadata.name] = metadata.metadata


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
    if max(announced, chunk.uncompressed_size) > LARGEST_CHUNK_BYTES:
        raise ValueError(f"a chunk says that it unpacks to over {LARGEST_CHUNK_BYTES} bytes")
    data, length = get_chunk_data_stream(chunk)
    return data.read(length)
