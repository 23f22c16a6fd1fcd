"""Outbox of a topic: the messages that at least one lossless consumer has not handled."""

from bisect import bisect_left
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
    """Store of the numbered messages of a topic, in memory or in a log on disk.

    An outbox has a log if a consumer may be far behind. `store` then writes the messages to the
    log, and only the newest messages stay in memory. An outbox that has no log holds all messages
    in memory, and the stage saves them with its state.
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
        """Messages that the stage saves with its state; empty if a log on disk has them."""
        return () if self._log else tuple(self._memory)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because the outbox reached its maximum size."""
        return self._dropped + (self._log.dropped if self._log else 0)

    @property
    def size_bytes(self) -> int:
        """Size of the messages in bytes: in the log on disk, or in memory if there is no log."""
        return self._log.size_bytes if self._log else self._bytes

    @property
    def max_bytes(self) -> int | None:
        """Maximum size of the messages, bytes; None if the size is not limited."""
        return self._log.max_bytes if self._log else self._max_bytes

    def first(self, end: int) -> int:
        """Return the number of the oldest message in the outbox.

        Args:
            end: Number to return if the outbox is empty.
        """
        with self._lock:
            in_memory = self._memory[0].seq if self._memory else end
        in_log = end if self._log is None or self._log.first == self._log.next else self._log.first
        return min(in_memory, in_log)

    def add(self, message: UnackedMessage) -> None:
        """Add the next message; drop the oldest messages if the outbox exceeds its maximum size."""
        with self._lock:
            self._memory.append(message)
            self._bytes += len(message.body)
            while self._max_bytes is not None and self._bytes > self._max_bytes:
                self._bytes -= len(self._memory.popleft().body)
                self._dropped += 1

    def store(self) -> None:
        """Write new messages to the log; do nothing if there is no log.

        This method may be called on any thread.

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
        """Return the message with number `seq`, or None if the outbox no longer has it.

        Call this method in a thread other than the event loop's, because it may read the disk.
        """
        with self._lock:  # Numbers ascend, with gaps where a message had no lossless consumer.
            place = bisect_left(self._memory, seq, key=lambda message: message.seq)
            if place < len(self._memory) and self._memory[place].seq == seq:
                return self._memory[place]
        found = self._log.read(seq) if self._log else None
        return UnackedMessage(*found) if found else None

    def after(self, seq: int, end: int) -> int:
        """Return the number of the message to read next, after message `seq` could not be read.

        Args:
            seq: Number of the message that could not be read.
            end: Number to return if the outbox has no later message.
        """
        with self._lock:
            later = [message.seq for message in self._memory if message.seq > seq]
        in_memory = min(later, default=end)
        return min(in_memory, self._log.after(seq, end) if self._log else end)

    def first_needed(self, handled: int) -> int:
        """Return the number of the first message that is still needed.

        A message is needed until all consumers have handled it. It is also needed while the service
        may fall back to older copies of the actors' states (a generation, see `keep`).

        Args:
            handled: Number of the first message that a consumer has not handled.
        """
        return min([handled, *self._handled_at_keeps[:1]])

    def keep(self, handled: int, *, is_previous_complete: bool) -> None:
        """Retain the messages that consumers need if the service falls back to older states.

        A generation has copies of the states of all actors; see `runtime.generations`. The stage
        calls this method when the producer copies its state for a new generation.

        The consumers copy their states before the producer does, and then handle further messages.
        A consumer that is restored from its copy needs these further messages again. The outbox
        therefore retains all messages that were unhandled when `keep` was called for the previous
        generation.

        Args:
            handled: Number of the first message that a consumer has not handled.
            is_previous_complete: Whether the previous generation is complete. If it is, the outbox
                no longer retains messages for generations before it.
        """
        if is_previous_complete:
            del self._handled_at_keeps[:-2]
        del self._handled_at_keeps[1:-2]  # The others are never used.
        self._handled_at_keeps.append(handled)
        self._is_kept = True

    def forget(self, before: int) -> None:
        """Delete the messages before number `before`, which all consumers have handled.

        Messages that a generation (copies of the states of all actors) needs stay in the outbox;
        see `keep`. An outbox in memory retains them only while its size is at most
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
        """Delete the messages from number `end` on; they were never sent."""
        with self._lock:
            while self._memory and self._memory[-1].seq >= end:
                self._bytes -= len(self._memory.pop().body)
        if self._log:
            self._log.truncate(end)

    def pop_unsynced(self) -> list[Path]:
        """Return the files and folders of the log that the caller must sync to the disk."""
        return self._log.pop_unsynced() if self._log else []

    def restart(self, epoch: int) -> None:
        """Delete all messages and restart the numbering at 0.

        Args:
            epoch: Number that identifies the new numbering.
        """
        with self._lock:
            self._memory.clear()
            self._bytes = 0
            self._handled_at_keeps = [0] if self._log and self._handled_at_keeps else []
        if self._log:
            self._log.restart(epoch)
