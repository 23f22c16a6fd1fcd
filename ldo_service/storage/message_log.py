"""Append-only log of numbered messages on disk, for consumers that are far behind."""

import logging
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from .atomic_write import make_folder, sync, with_folders

log = logging.getLogger(__name__)

# Size in bytes at which the log starts a new segment. A segment is one file. It is deleted only as
# a whole, so handled messages may still occupy this much disk space.
SEGMENT_BYTES = 32_000_000
# Record before each message: its number, the sizes of its header and body in bytes, and the
# CRC-32 of both.
_RECORD = struct.Struct("<QIII")


class LoggedMessage(NamedTuple):
    """Message that a `MessageLog` stores."""

    seq: int  # Number of the message.
    header: bytes  # Encoded header.
    body: bytes  # Encoded message.


@dataclass
class _Segment:
    """File with consecutive messages."""

    path: Path
    first: int  # Number of its first message.
    # File position after each message, bytes. Message `first + i` ends at `ends[i]`.
    ends: list[int] = field(default_factory=list)

    @property
    def next(self) -> int:
        return self.first + len(self.ends)

    @property
    def size(self) -> int:
        return self.ends[-1] if self.ends else 0


class MessageLog:
    """Log of messages in a folder; any thread may call its methods.

    The numbers of the messages are consecutive, except where messages were lost, for example in a
    power cut.

    The oldest messages are deleted when the log exceeds its maximum size. A producer that begins
    without a saved state takes a new epoch number, and counts its messages from 0 again. The log
    has messages of one epoch, and deletes files of other epochs.
    """

    def __init__(
        self, folder: Path, epoch: int, first: int, end: int, *, max_bytes: int, syncs: bool = False
    ) -> None:
        """Open the log, and discard messages outside a range.

        Args:
            folder: Folder of the log; created with the first message.
            epoch: Epoch of the numbers.
            first: Number of the first message that a consumer or a generation of the states needs.
            end: Number after the last message to keep. A killed process may have written messages
                with this number and above.
            max_bytes: Maximum size of the log, bytes.
            syncs: Sync every message to the disk, so that the log survives a power cut too.
        """
        self._folder, self._epoch, self.max_bytes, self._syncs = folder, epoch, max_bytes, syncs
        self._lock = Lock()
        self._segments: list[_Segment] = []
        self._open: _Segment | None = None  # The segment that is being written.
        self._first = self._handled = first
        self._unsynced: set[Path] = set()  # Files written since the last `pop_unsynced`.
        self.dropped = 0  # Messages deleted because of the maximum size.
        self._scan(end)
        self.forget(first)

    @property
    def first(self) -> int:
        """Number of the first message; equal to `next` if the log is empty."""
        with self._lock:
            return max(self._first, self._segments[0].first) if self._segments else self._first

    @property
    def next(self) -> int:
        """Number of the message to append next."""
        with self._lock:
            return self._next

    @property
    def _next(self) -> int:
        return self._segments[-1].next if self._segments else self._first

    @property
    def size_bytes(self) -> int:
        """Size of all files, bytes."""
        with self._lock:
            return sum(segment.size for segment in self._segments)

    def append(self, messages: Iterable[LoggedMessage]) -> None:
        """Append messages with ascending numbers; messages with numbers before `next` are skipped.

        Only one thread may append at a time. Other methods do not wait for the disk while a thread
        appends.

        Raises:
            OSError: The disk is full or cannot be written. The log then ends with a whole message.
        """
        for message in messages:
            with self._lock:
                if message.seq < self._next:
                    continue
                segment = self._open = self._segment_for(message.seq)
            try:
                end = self._write(segment, message)
                with self._lock:
                    segment.ends.append(end)
                    self._unsynced.add(segment.path)
                    self._drop_oldest()
            finally:
                self._open = None

    def _segment_for(self, seq: int) -> _Segment:
        """Return the segment for message `seq`.

        It is a new segment if the last one is full or if messages before `seq` were lost.
        """
        last = self._segments[-1] if self._segments else None
        if last is not None and seq == last.next and last.size < SEGMENT_BYTES:
            return last
        if last is None:
            self._first = seq
        self._segments.append(_Segment(self._path(seq), seq))
        return self._segments[-1]

    def _write(self, segment: _Segment, message: LoggedMessage) -> int:
        """Write a message to the end of a segment, and return the position after it."""
        header, body = message.header, message.body
        make_folder(self._folder)
        with segment.path.open("r+b" if segment.ends else "wb") as file:
            file.seek(segment.size)
            file.write(_RECORD.pack(message.seq, len(header), len(body), _checksum(header, body)))
            file.write(header)
            file.write(body)
        if self._syncs:
            sync(segment.path)
            if not segment.ends:
                sync(self._folder)
        return segment.size + _RECORD.size + len(header) + len(body)

    def _drop_oldest(self) -> None:
        """Delete the oldest segments beyond the maximum size, but never the last one."""
        size = sum(segment.size for segment in self._segments)
        while size > self.max_bytes and len(self._segments) > 1:
            oldest = self._segments.pop(0)
            size -= oldest.size
            self.dropped += max(0, oldest.next - max(self._handled, self._first, oldest.first))
            self._first = oldest.next
            _remove(oldest.path)

    def pop_unsynced(self) -> list[Path]:
        """Return the files written since the last call, and their folders.

        The next call does not return these files again. The caller must therefore sync them, and
        must retry a failed sync.
        """
        with self._lock:
            paths = sorted(self._unsynced)
            self._unsynced.clear()
        return with_folders(paths)

    def read(self, seq: int) -> LoggedMessage | None:
        """Return a message; None if it was deleted or its file is damaged."""
        with self._lock:
            segment = self._segment_of(seq)
            if segment is None or seq < self._first:
                return None
            number = seq - segment.first
            start = segment.ends[number - 1] if number else 0
            size = segment.ends[number] - start
        try:
            with segment.path.open("rb") as file:
                file.seek(start)
                raw = file.read(size)
        except OSError as error:
            log.error(
                "%s cannot be read (%s); message %d is lost. Check the disk.",
                segment.path, error, seq,
            )  # fmt: skip
            return None
        if len(raw) < size:
            log.error("%s is truncated; message %d is lost. Check the disk.", segment.path, seq)
            return None
        _, header_bytes, _, checksum = _RECORD.unpack_from(raw)
        end = _RECORD.size + header_bytes
        header, body = raw[_RECORD.size : end], raw[end:]
        if _checksum(header, body) != checksum:
            log.error("%s is damaged; message %d is lost. Check the disk.", segment.path, seq)
            return None
        return LoggedMessage(seq, header, body)

    def after(self, seq: int, end: int) -> int:
        """Return the number of the next message to read, after message `seq` was unreadable.

        Args:
            seq: Number of the unreadable message.
            end: Number to return if the log has no message after `seq`.
        """
        with self._lock:
            if self._segment_of(seq) is not None:
                return seq + 1
            later = [segment.first for segment in self._segments if segment.first > seq]
        return min(later, default=end)

    def forget(self, before: int, handled: int = 0) -> None:
        """Delete the files of the log that only have messages with numbers below `before`.

        Args:
            before: Number of the first message that a consumer or a copy of the states still needs.
            handled: All consumers have handled the messages before this number. If the log exceeds
                its maximum size and deletes these messages, they do not count as dropped.
        """
        with self._lock:
            self._first, self._handled = max(self._first, before), max(self._handled, handled)
            while (
                self._segments
                and self._segments[0].next <= before
                and self._segments[0] is not self._open
            ):
                _remove(self._segments.pop(0).path)

    def truncate(self, end: int) -> None:
        """Delete the messages with numbers of at least `end`."""
        with self._lock:
            while self._segments and self._segments[-1].first >= end:
                _remove(self._segments.pop().path)
            if self._segments and self._segments[-1].next > end:
                last = self._segments[-1]
                del last.ends[end - last.first :]
                with suppress(OSError), last.path.open("r+b") as file:
                    file.truncate(last.size)

    def restart(self, epoch: int) -> None:
        """Delete all messages and begin at number 0 of a new epoch."""
        with self._lock:
            self._clear()
            self._epoch, self._first, self._handled = epoch, 0, 0

    def _clear(self) -> None:
        while self._segments:
            _remove(self._segments.pop().path)

    def _segment_of(self, seq: int) -> _Segment | None:
        place = bisect_right(self._segments, seq, key=lambda segment: segment.first) - 1
        if place < 0 or seq >= self._segments[place].next:
            return None
        return self._segments[place]

    def _path(self, first: int) -> Path:
        return self._folder / f"{self._epoch}-{first:012d}.log"

    def _scan(self, end: int) -> None:
        """Index the messages below `end` of this epoch, and delete the files of other epochs."""
        starts: list[int] = []  # First message of each file, and the end of its whole messages.
        ends: list[int] = []
        for path in sorted(self._folder.glob("*.log")):
            epoch, _, number = path.stem.partition("-")
            first = int(number) if number.isdecimal() else -1
            follows = not self._segments or first >= self._segments[-1].next
            if epoch != str(self._epoch) or first < 0 or not follows:
                _remove(path)
                continue
            segment = _Segment(path, first, _ends(path, first))
            starts.append(first)
            ends.append(segment.next)
            if segment.ends:
                self._segments.append(segment)
                self._unsynced.add(path)
            else:
                _remove(path)
        self.truncate(end)
        for missing, stop in zip(ends or [self._first], [*starts[1:], end], strict=True):
            self._log_missing(missing, min(stop, end))

    def _log_missing(self, first: int, end: int) -> None:
        if first < end:
            log.error(
                "%s: messages %d to %d are missing or damaged, and are lost. Check the disk, "
                "unless the power failed.",
                self._folder, first, end - 1,
            )  # fmt: skip


def _ends(path: Path, first: int) -> list[int]:
    """Return the position after each whole message of a file."""
    ends: list[int] = []
    with suppress(OSError), path.open("rb") as file:
        size = path.stat().st_size
        while len(raw := file.read(_RECORD.size)) == _RECORD.size:
            seq, header, body, _ = _RECORD.unpack(raw)
            end = file.tell() + header + body
            if seq != first + len(ends) or end > size:
                break
            ends.append(end)
            file.seek(end)
    return ends


def _checksum(header: bytes, body: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(header))


def _remove(path: Path) -> None:
    """Remove a file; if that fails, the next process removes it."""
    with suppress(OSError):
        path.unlink()
