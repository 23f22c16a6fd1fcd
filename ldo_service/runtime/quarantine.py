"""Quarantine of messages that crash or block the process of the actor that handles them.

If handling a message raises an exception twice, the stage discards the message as a dead letter. A
message that kills the process (SIGSEGV, out of memory) or hangs would be delivered again after each
restart. Before a stage handles a message, it therefore writes to disk how often the message was
delivered.
"""

import asyncio
import hashlib
import logging
import os
import struct
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, nullcontext, suppress
from pathlib import Path

import msgspec

from ldo_service.storage.atomic_write import write_atomically

from .actor import Lossless
from .inlet import Delivery

log = logging.getLogger(__name__)

MAX_DELIVERIES = 3  # Deliveries after which a message that ended its process is not handled again.
MAX_FILES = 20  # Messages that are kept on the disk; older ones are deleted.
SUFFIX = ".message"
MAX_SUSPECTS = 8  # Messages whose deliveries are counted; the oldest ones are dropped.
_RECORD = struct.Struct("<16sII")  # Digest of the last message, its deliveries, all quarantined.
_SUSPECT = struct.Struct("<16sI")  # Digest of an earlier message, its deliveries; 0 if unused.
_CHECKSUM = struct.Struct("<I")  # CRC-32 of everything before it.
_SUSPECTS_SIZE = (MAX_SUSPECTS - 1) * _SUSPECT.size


class QuarantinedMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Content of a file in the quarantine folder: one message, encoded as MessagePack."""

    topic: str  # Name of the topic.
    source: str  # Header fields of the message; see `flow_control.Header`.
    epoch: int
    seq: int
    stamp_ns: int
    deliveries: int  # Number of deliveries, each of which ended the process.
    body: bytes  # Encoded message.


class Quarantine:
    """Delivery counts of messages that may have ended the process, and of the current message.

    Before a stage handles a message of a lossless input, it writes to disk how often the message
    was delivered. If the process ends during the handling, the restarted stage receives the message
    again. The message is then suspected to have ended the process. After `MAX_DELIVERIES`
    deliveries, the stage writes the message to the folder instead of handling it. The restarted
    stage may first receive messages of other inputs, or messages whose steps were not saved. The
    count of a suspected message stays until that message itself is handled.

    The actors of one process handle only one suspected message at a time. If the process ends
    again, the counts of the other suspected messages stay the same. Messages of inputs that are not
    lossless are never delivered again and therefore not counted.

    Attributes:
        count: Number of messages quarantined since the state folder was created.
    """

    def __init__(self, folder: Path | None, suspects: asyncio.Lock | None = None) -> None:
        """Read the counts that the previous process wrote.

        Args:
            folder: Folder of the counts and messages; None: nothing is counted.
            suspects: Lock of this process for the handling of suspected messages.
        """
        self._folder, self._suspects = folder, suspects or asyncio.Lock()
        self._deliveries: dict[bytes, int] = {}  # The keys are digests; the last message is last.
        self._key, self.count = b"", 0  # Digest of the message that is being handled.
        if folder is not None:
            self._load()

    def is_due(self, delivery: Delivery) -> bool:
        """Return whether a message was delivered so often that it must be quarantined."""
        return self._deliveries_of(delivery) >= MAX_DELIVERIES

    @asynccontextmanager
    async def counting(self, delivery: Delivery | None) -> AsyncIterator[None]:
        """Increment the delivery count of a message, then run the block that handles the message.

        The count is cleared when the block returns or raises an exception. It stays on disk if the
        process ends inside the block. It also stays if the block is cancelled; the stage then calls
        `withdraw`.
        """
        if self._folder is None or delivery is None or not _is_repeated(delivery):
            yield
            return
        is_suspect = self._deliveries_of(delivery) > 0
        async with self._suspects if is_suspect else nullcontext():
            self._key = _key_of(delivery)
            self._store(self._key, self._deliveries_of(delivery) + 1)
            try:
                yield
            except Exception:
                self._clear()
                raise
            self._clear()

    def withdraw(self) -> None:
        """Decrement the delivery count of a message whose handling was cancelled by a stop."""
        if deliveries := self._deliveries.get(self._key, 0):
            self._store(self._key, deliveries - 1)

    def add(self, actor: str, delivery: Delivery) -> int:
        """Write a message to the quarantine folder, log an error, and return the new `count`."""
        assert self._folder is not None
        self.count += 1
        deliveries = self._deliveries_of(delivery)
        # The message stays due until the stage has saved.
        self._store(_key_of(delivery), deliveries)
        header, topic = delivery.header, delivery.port.topic.name
        path = self._folder / f"{topic.replace('/', '.')}-{header.epoch}-{header.seq}{SUFFIX}"
        message = QuarantinedMessage(
            topic=topic,
            source=header.source,
            epoch=header.epoch,
            seq=header.seq,
            stamp_ns=header.stamp_ns,
            deliveries=deliveries,
            body=bytes(delivery.body),
        )
        try:
            write_atomically(path, msgspec.msgpack.encode(message))
            self._remove_oldest(path)
            where = f"It is saved as {path}"
        except OSError as error:
            where = f"It cannot be saved: {error}"
        log.error(
            "%s: message %d of %s (stamp %d ns) ended this actor's process %d times and is "
            "quarantined (%d so far). %s. Please report it with the log of the process.",
            actor, header.seq, topic, header.stamp_ns, deliveries, self.count, where,
        )  # fmt: skip
        return self.count

    @property
    def _path(self) -> Path:
        assert self._folder is not None
        return self._folder / "deliveries"

    def _deliveries_of(self, delivery: Delivery) -> int:
        return self._deliveries.get(_key_of(delivery), 0) if _is_repeated(delivery) else 0

    def _clear(self) -> None:
        self._store(self._key, 0)
        self._key = b""

    def _load(self) -> None:
        with suppress(OSError):
            body = self._path.read_bytes()
            # A record without checksum, or without suspects, is of an older version.
            content, checksum = body[: -_CHECKSUM.size], body[-_CHECKSUM.size :]
            if len(body) == _RECORD.size:
                content = body
            elif checksum != _CHECKSUM.pack(zlib.crc32(content)) or len(content) not in (
                _RECORD.size,
                _RECORD.size + _SUSPECTS_SIZE,
            ):
                log.error(
                    "%s is damaged: the counts of repeated messages start again at 0. Check the "
                    "disk, unless the power failed.",
                    self._path,
                )
                return
            key, deliveries, self.count = _RECORD.unpack(content[: _RECORD.size])
            suspects = [*_SUSPECT.iter_unpack(content[_RECORD.size :])][::-1]
            self._deliveries = {k: n for k, n in (*suspects, (key, deliveries)) if n}

    def _store(self, key: bytes, deliveries: int) -> None:
        """Write the count of a message; without disk space, it is lost with this process.

        Args:
            key: Digest of the message.
            deliveries: The count; 0 deletes it.
        """
        self._deliveries.pop(key, None)
        if deliveries:
            self._deliveries[key] = deliveries
        while len(self._deliveries) > MAX_SUSPECTS:
            del self._deliveries[next(iter(self._deliveries))]
        (last, *others) = [*reversed(self._deliveries.items())] or [(b"", 0)]
        content = _RECORD.pack(*last, self.count) + b"".join(_SUSPECT.pack(*one) for one in others)
        content = content.ljust(_RECORD.size + _SUSPECTS_SIZE, b"\0")
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o600)
            try:
                os.pwrite(descriptor, content + _CHECKSUM.pack(zlib.crc32(content)), 0)
            finally:
                os.close(descriptor)

    def _remove_oldest(self, newest: Path) -> None:
        """Remove the oldest files, but not the newest, whose time may be wrong like the clock."""
        others = [file for file in newest.parent.glob(f"*{SUFFIX}") if file != newest]
        others.sort(key=lambda file: file.stat().st_mtime_ns)
        for file in others[: -(MAX_FILES - 1)]:
            file.unlink(missing_ok=True)


def _is_repeated(delivery: Delivery) -> bool:
    return isinstance(delivery.port.policy, Lossless)


def _key_of(delivery: Delivery) -> bytes:
    header = delivery.header
    text = f"{delivery.port.topic.name} {header.source} {header.epoch} {header.seq}"
    return hashlib.blake2b(text.encode(), digest_size=16).digest()
