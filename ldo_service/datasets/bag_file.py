"""Files of ROS bags, read with the library rosbags: their topics, and messages in any order.

*.bag            one file of ROS 1; RealSense Viewer writes such files too
*.mcap *.db3     one file of ROS 2; RealSense Viewer writes *.db3 too
metadata.yaml    in a folder with one or several files of ROS 2

The readers of rosbags iterate over messages in the order of time. Reading one message would need
time proportional to the number of messages before it. The classes of this module therefore remember
where each message is stored, and restrict the reader to the index entry of the wanted message.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any, Protocol
from weakref import finalize

from ldo_service.cameras.ros_messages import IMAGE, decoded, typestore
from ldo_service.errors import ConfigError, DataError, FrameError, LdoError, install_command

# First bytes of a file, by its suffix.
MAGIC = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
SUFFIXES = tuple(MAGIC)
METADATA = "metadata.yaml"  # File in the folder of a bag of ROS 2.
LAST_STAMP_NS = 2**63 - 1  # Maximum of int64, in the year 2262.
# RealSense Viewer appends the depth unit to each image of ROS 1, as a 4-byte float.
REALSENSE_TAIL = 4


def is_bag(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a bag, or a folder with files of a bag."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return (path / METADATA).is_file() or any(path.glob("*.db3"))


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic of a bag."""

    name: str
    kind: str  # Type of the messages, such as sensor_msgs/msg/Image.
    connections: tuple[Any, ...]  # Connections of rosbags: one for each publisher.
    count: int  # Number of messages.


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """Message in a bag."""

    # Stamp in the header of the message; where it is 0, the time of recording. It is
    # meaningless for types without a header.
    stamp_ns: int
    connection: Any  # Connection of rosbags: topic and type of the message.
    place: Any  # Location in the file: entry of the index (ROS 1), or a `_Ros2Place`.


class BagFile:
    """Bag of ROS 1 or ROS 2; several threads may read it."""

    def __init__(self, path: Path) -> None:
        """Open a bag and read its index.

        Raises:
            ConfigError: The extra `bags` is not installed.
            DataError: The bag is damaged or has no index.
        """
        _require_rosbags()
        _require_magic(path)
        self.path = path
        self.read_topics: set[str] = set()  # Names of the topics of `messages`.
        self._lock = Lock()
        with self._readable():
            is_ros1 = path.suffix.lower() == ".bag" and path.is_file()
            reader = _ros1_reader(path) if is_ros1 else _ros2_reader(path)
            finalize(self, reader.close)
            self._format: _Format = _Ros1(reader) if is_ros1 else _Ros2(reader)
            self.topics = dict(sorted(_topics(reader.connections).items()))

    def messages(self, topics: Sequence[Topic], limit: int | None = None) -> list[StoredMessage]:
        """Return the stamps and locations of the messages of topics, in the order of the file.

        Args:
            topics: The topics.
            limit: Maximum number of messages; None returns all.

        Raises:
            DataError: A part of the file cannot be read.
        """
        connections = [connection for topic in topics for connection in topic.connections]
        self.read_topics.update(topic.name for topic in topics)
        with self._lock, self._readable():
            return list(islice(self._format.messages(connections), limit))

    def read(self, message: StoredMessage) -> Any:
        """Return a decoded message.

        Raises:
            FrameError: The message cannot be read or decoded.
        """
        try:
            with self._lock:
                raw = self._format.read(message.connection, message.place)
            body = self._format.to_cdr(raw, message.connection.msgtype)
        except Exception as error:  # rosbags raises errors of many kinds for damaged files.
            raise FrameError(
                f"{self.path}: a message of {message.connection.topic} cannot be read: "
                f"{_text(error)}. {_advice(self.path)}"
            ) from error
        return decoded(body, message.connection.msgtype)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except LdoError:
            raise
        except Exception as error:  # rosbags raises errors of many kinds for damaged files.
            raise DataError(
                f"{self.path} cannot be read as a bag of ROS: {_text(error)}. {_advice(self.path)}"
            ) from error


class _Format(Protocol):
    """File format of bags: stored messages in the order of the file, and random access."""

    def messages(self, connections: Sequence[Any]) -> Iterator[StoredMessage]: ...

    def read(self, connection: Any, place: Any) -> bytes: ...

    def to_cdr(self, raw: bytes, kind: str) -> bytes: ...


class _Ros1:
    """Bag of ROS 1: a message is found by an entry of the index, which names chunk and offset."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self._entries = reader.indexes

    def messages(self, connections: Sequence[Any]) -> Iterator[StoredMessage]:
        entries = [(entry, link) for link in connections for entry in self._entries[link.id]]
        entries.sort(key=lambda found: (found[0].chunk_pos, found[0].offset))
        for entry, connection in entries:
            # The header of a message is a sequence number, and the seconds and nanoseconds of the
            # stamp.
            raw = self.read(connection, entry)
            _, seconds, nanoseconds = _unpacked("<III", raw, 0)
            yield _stored(seconds, nanoseconds, entry.time, connection, entry)

    def read(self, connection: Any, place: Any) -> bytes:
        self._reader.indexes = {connection.id: [place]}
        ((_, _, raw),) = self._reader.messages([connection])
        return raw

    def to_cdr(self, raw: bytes, kind: str) -> bytes:
        try:
            return bytes(typestore().ros1_to_cdr(raw, kind))
        except Exception:
            if kind != IMAGE:
                raise
            return bytes(typestore().ros1_to_cdr(raw[:-REALSENSE_TAIL], kind))


@dataclass(frozen=True, slots=True)
class _Ros2Place:
    """Place of a message in a bag of ROS 2."""

    part: int  # Index of the file, or of the chunk of MCAP.
    time_ns: int  # Time of recording.
    number: int  # Number of the message among those of equal part, connection and time.


class _Ros2:
    """Bag of ROS 2: a message is found by file, chunk and time of recording.

    Sqlite has an index over the time. In MCAP, each chunk has such an index.
    """

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        files = getattr(reader.storage, "storages", [reader.storage])
        self._parts = [(file, chunk) for file in files for chunk in _chunks(file)]

    def messages(self, connections: Sequence[Any]) -> Iterator[StoredMessage]:
        for part in range(len(self._parts)):
            self._select(part)
            seen: Counter[tuple[int, int]] = Counter()
            for connection, time_ns, raw in self._reader.messages(connections):
                key = connection.id, time_ns
                place = _Ros2Place(part, time_ns, seen[key])
                seen[key] += 1
                # The header of CDR has the byte order; the message begins with its stamp.
                order = "<" if raw[1:2] == b"\1" else ">"
                seconds, nanoseconds = _unpacked(order + "iI", raw, 4)
                yield _stored(seconds, nanoseconds, time_ns, connection, place)

    def read(self, connection: Any, place: _Ros2Place) -> bytes:
        self._select(place.part)
        found = self._reader.messages([connection], place.time_ns, place.time_ns + 1)
        return next(islice(found, place.number, None))[2]

    def to_cdr(self, raw: bytes, kind: str) -> bytes:
        del kind  # The message is CDR already.
        return bytes(raw)

    def _select(self, part: int) -> None:
        """Restrict the reader to one part: a file, or a chunk of an MCAP file."""
        file, chunk = self._parts[part]
        if hasattr(self._reader.storage, "storages"):
            self._reader.storage.storages = [file]
        if chunk is not None:
            file.chunks = [chunk]


def _chunks(file: Any) -> list[Any]:
    """Return the chunks of an MCAP file, or [None] for sqlite.

    Raises:
        DataError: The MCAP file has no index of chunks.
    """
    if not hasattr(file, "chunks"):
        return [None]
    if not file.chunks and file.metadata.message_count:
        raise DataError(
            f"{file.path} has no index of chunks. Write it again with an index by `mcap filter "
            f"{file.path.name} -o indexed.mcap`."
        )
    return file.chunks


def _topics(connections: Sequence[Any]) -> dict[str, Topic]:
    """Return the topics by name.

    The first connection of a topic determines its message type. Connections of the topic with
    another type are skipped.
    """
    names: dict[str, list[Any]] = {}
    for connection in connections:
        names.setdefault(connection.topic, []).append(connection)
    topics = {}
    for name, found in names.items():
        kind = found[0].msgtype
        equal = tuple(connection for connection in found if connection.msgtype == kind)
        topics[name] = Topic(name, kind, equal, sum(int(link.msgcount) for link in equal))
    return topics


def _unpacked(layout: str, raw: bytes, start: int) -> tuple[int, ...]:
    """Unpack numbers of a header; zeros if the message is too short."""
    size = struct.calcsize(layout)
    return struct.unpack(layout, bytes(raw[start : start + size]).ljust(size, b"\0"))


def _stored(
    seconds: int, nanoseconds: int, time_ns: int, connection: Any, place: Any
) -> StoredMessage:
    stamp_ns = seconds * 10**9 + nanoseconds
    stamp_ns = stamp_ns if stamp_ns > 0 else time_ns
    if not 0 <= stamp_ns <= LAST_STAMP_NS:
        raise ValueError(
            f"a message of {connection.topic} has the time {stamp_ns} ns, must be 0 to "
            f"{LAST_STAMP_NS} ns"
        )
    return StoredMessage(stamp_ns, connection, place)


def _ros1_reader(path: Path) -> Any:
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    reader.open()
    return reader


def _ros2_reader(path: Path) -> Any:
    from rosbags.rosbag2 import Reader

    reader = Reader(path)
    reader.open()
    return reader


def _require_magic(path: Path) -> None:
    """Check the first bytes of a file, before rosbags reads it as something that it is not.

    Raises:
        DataError: The file cannot be read, is empty, or is no bag.
    """
    if path.is_dir():
        return
    magic = MAGIC[path.suffix.lower()]
    try:
        with path.open("rb") as file:
            found = file.read(len(magic))
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Check its permissions, or copy it again."
        ) from error
    if not found:
        raise DataError(f"{path} is empty. Copy it again, or check that the recorder had started.")
    if found != magic:
        raise DataError(
            f"{path} is no bag of ROS: it begins with {found!r}, expected {magic!r}. Check that it "
            "is the right file."
        )


def _require_rosbags() -> None:
    try:
        import rosbags.rosbag1
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"reading a bag of ROS needs the extra `bags`. Install it by {install_command('bags')}."
        ) from error


def _text(error: Exception) -> str:
    """Return the text of an error of rosbags in one line, without the period."""
    text = " ".join(str(error).split())[:300].rstrip(".")
    return text if type(error).__name__ == "ReaderError" else f"{type(error).__name__}: {text}"


def _advice(path: Path) -> str:
    repair = {".bag": f"rosbag reindex {path.name}", ".mcap": f"mcap recover {path.name}"}
    command = repair.get(path.suffix, f"ros2 bag reindex {path.name}")
    return f"Copy it again. If it was not closed properly, repair it by `{command}`."
