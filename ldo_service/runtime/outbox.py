"""Outbox of a topic: the messages that at least one lossless consumer has not handled."""

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from threading import Lock

from ldo_service.storage.message_log import LoggedMessage, MessageLog
from ldo_service.transport.flow_control import UnackedMessage

# Number of newest messages that stay in memory although the log on disk has them.
# Retransmissions to consumers that are not far behind then need not read the disk.
MESSAGES_IN_MEMORY = 8
# Maximum size of handled messages that are retained in memory for the next generation, or on
# disk for the first one, bytes: some tens of keyframes.
MAX_RETAINED_BYTES = 64_000_000


class Outbox:
    """Numbered messages in order, in memory or on disk.

    They are on disk if a consumer may be far behind.

    Without a log, all messages are in memory, and the stage saves them with its state. With a log,
    `store` writes them to disk, and only the newest stay in memory.
    """

    def __init__(
        self,
        unhandled: Iterable[UnackedMessage] = (),
        log: MessageLog | None = None,
        max_bytes: int | None = None,
        retained_from: int | None = None,
        is_kept: bool = True,
    ) -> None:
        """Initialize with the messages of the previous process.

        Args:
            unhandled: Messages that the previous process saved with its state.
            log: Log on disk, which has its own maximum size; None: all messages are in memory.
            max_bytes: Maximum size of an outbox in memory, bytes. The oldest messages beyond it are
                dropped. None: the log or the consumers' windows limit the size of the outbox.
            retained_from: Number of the first message that a generation of the states needs; see
                `runtime.generations`. None if there is no generation.
            is_kept: False if `retained_from` is for the first generation, which may never be kept.
                Messages on disk are then retained up to `MAX_RETAINED_BYTES`.
        """
        self._lock = Lock()
        self._memory = deque(unhandled)
        self._log, self._max_bytes = log, max_bytes
        self._bytes = sum(len(message.body) for message in self._memory)
        self._dropped = 0  # Messages dropped from memory.
        self._is_kept = is_kept
        # First unhandled message when each of the last generations was kept; see `keep`.
        self._handled_at_keeps = [] if retained_from is None else [retained_from]

    @property
    def is_logged(self) -> bool:
        """True if the messages are written to a log on disk."""
        return self._log is not None

    @property
    def in_memory(self) -> tuple[UnackedMessage, ...]:
        """Messages to save with the state of the stage; none if they are in a log."""
        return () if self._log else tuple(self._memory)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because of the maximum size."""
        return self._dropped + (self._log.dropped if self._log else 0)

    @property
    def size_bytes(self) -> int:
        """Size of the messages on disk, or in memory if there is no log, bytes."""
        return self._log.size_bytes if self._log else self._bytes

    @property
    def max_bytes(self) -> int | None:
        """Maximum of `size_bytes`; None if there is no maximum."""
        return self._log.max_bytes if self._log else self._max_bytes

    def first(self, end: int) -> int:
        """Return the number of the first message; `end` if there is none.

        Args:
            end: Number after the last message.
        """
        with self._lock:
            in_memory = self._memory[0].seq if self._memory else end
        in_log = end if self._log is None or self._log.first == self._log.next else self._log.first
        return min(in_memory, in_log)

    def add(self, message: UnackedMessage) -> None:
        """Add the next message."""
        with self._lock:
            self._memory.append(message)
            self._bytes += len(message.body)
            while self._max_bytes is not None and self._bytes > self._max_bytes:
                self._bytes -= len(self._memory.popleft().body)
                self._dropped += 1

    def store(self) -> None:
        """Write the messages to the log, if there is one; may be called on any thread.

        Raises:
            OSError: The log cannot be written. All messages stay in memory.
        """
        if self._log is None:
            return
        with self._lock:
            new = [m for m in self._memory if m.seq >= self._log.next]
        self._log.append(LoggedMessage(*message) for message in new)
        with self._lock:
            while len(self._memory) > MESSAGES_IN_MEMORY and self._memory[0].seq < self._log.next:
                self._bytes -= len(self._memory.popleft().body)

    def read(self, seq: int) -> UnackedMessage | None:
        """Return message `seq`, or None if it is lost.

        The call may read the disk, so it belongs in a thread.
        """
        with self._lock:
            if self._memory and self._memory[0].seq <= seq <= self._memory[-1].seq:
                return self._memory[seq - self._memory[0].seq]
        found = self._log.read(seq) if self._log else None
        return UnackedMessage(*found) if found else None

    def after(self, seq: int, end: int) -> int:
        """Return the number of the next message that may be readable after a lost message.

        Args:
            seq: Number of the lost message.
            end: Number after the last message.
        """
        with self._lock:
            later = [message.seq for message in self._memory if message.seq > seq]
        in_memory = min(later, default=end)
        return min(in_memory, self._log.after(seq, end) if self._log else end)

    def first_needed(self, handled: int) -> int:
        """Return the number of the first message that a consumer or a generation needs.

        A generation is an older copy of all saved states; see `keep`.

        Args:
            handled: All consumers have handled the messages before this number.
        """
        return min([handled, *self._handled_at_keeps[:1]])

    def keep(self, handled: int, *, is_previous_complete: bool) -> None:
        """Retain the messages that the next generation of the states needs.

        The consumers keep their states first (`runtime.generations`). Until this producer keeps its
        own state, they may handle further messages, which their kept states still need. The kept
        states are newer than the previous call of this method. The outbox therefore retains all
        messages that were unhandled at that call.

        Args:
            handled: All consumers have handled the messages before this number.
            is_previous_complete: Whether the generation of the previous call is complete, so that
                no older one is needed.
        """
        if is_previous_complete:
            del self._handled_at_keeps[:-2]
        del self._handled_at_keeps[1:-2]  # The others are never used.
        self._handled_at_keeps.append(handled)
        self._is_kept = True

    def forget(self, before: int) -> None:
        """Delete the messages before number `before`, which all consumers have handled.

        Messages that a generation (an older copy of all saved states) needs are kept, see `keep`.
        An outbox that is not on the disk keeps them only while it has at most
        `MAX_RETAINED_BYTES`.
        """
        if self._log and not self._is_kept and self._log.size_bytes > MAX_RETAINED_BYTES:
            self._handled_at_keeps = [before]
        needed = self.first_needed(before)
        if self._log:
            self._log.forget(needed, handled=before)
        elif self._bytes <= MAX_RETAINED_BYTES:
            before = needed
        with self._lock:
            while self._memory and self._memory[0].seq < before:
                self._bytes -= len(self._memory.popleft().body)

    def truncate(self, end: int) -> None:
        """Delete the messages with numbers of at least `end`, which were never sent."""
        with self._lock:
            while self._memory and self._memory[-1].seq >= end:
                self._bytes -= len(self._memory.pop().body)
        if self._log:
            self._log.truncate(end)

    def pop_unsynced(self) -> list[Path]:
        """Return the files of the log that are not synced to the disk yet."""
        return self._log.pop_unsynced() if self._log else []

    def restart(self, epoch: int) -> None:
        """Delete all messages and begin at number 0 of a new epoch."""
        with self._lock:
            self._memory.clear()
            self._bytes = 0
            self._handled_at_keeps = [0] if self._log and self._handled_at_keeps else []
        if self._log:
            self._log.restart(epoch)
