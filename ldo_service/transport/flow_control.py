"""Flow control between a producer and its lossless consumers, over a lossy network.

- `ConsumerHello` (consumer to producer): Announces the consumer with a random number, its nonce. It
  is repeated until the producer answers it.
- `ProducerHello` (producer to consumers): Announces the producer. It contains the epoch, which
  changes when the message numbers restart at 0. For each consumer that the producer knows, it
  contains the offset of the first message that is sent to this consumer, and the last nonce of
  this consumer. Each consumer replies immediately: with its credit, or with a hello if it is not
  connected yet. A consumer connects to a new epoch only if the hello contains the last nonce of
  this consumer, because other hellos may be older than the connection.
- `Credit` (consumer to producer): Three message offsets, sent after each handled message and twice
  a second. `handled` is the offset of the first message that the consumer has not handled.
  `arrived` is the offset of the first message that has not arrived. `limit` is the offset of the
  first message that the producer may not send yet.

Each of these three messages contains the complete state of its sender, not a change of the state.
A message may therefore be lost, repeated or replaced by a newer one of the same kind.

The producer keeps a message until all consumers have handled it, and waits when a consumer has a
full window of unhandled messages. It does not wait for a consumer with policy `Backlog`: it stores
the unhandled messages of such a consumer on disk. The producer retransmits all messages from offset
`arrived` on in two cases: a credit reports a gap, or the message at this offset has not arrived in
time. A restarted consumer receives the messages that it had not handled. Producer and consumer each
save their position in one write with the actor's state (`runtime.delivery_state`). Each message
therefore takes effect exactly once, even if either process is killed at any time. `SequenceTracker`
counts lost messages by their sequence numbers.
"""

import secrets
from typing import NamedTuple

import msgspec

from ldo_service.schemas import decode
from ldo_service.schemas.message import LAST_INTEGER

MAX_SEQ = 1 << 62
ALIVE = "link/alive"  # Key of the liveliness tokens of running actors.

# Maximum number of missing messages that are remembered, because they may still arrive: half a
# minute of camera frames.
MAX_MISSING = 1024

# Largest jump of the sequence numbers that counts as lost messages: those of 124 days at 100
# messages per second. A larger jump counts as the start of a new numbering, because any program may
# send any number.
MAX_JUMP = 1 << 30

# Maximum size of an encoded header, bytes. Names of producers and keys have tens of characters.
MAX_HEADER_BYTES = 4096


class Header(msgspec.Struct, frozen=True, array_like=True):
    """Header of a message.

    It is sent as an attachment, apart from the body, so that other programs can decode the body
    directly.
    """

    source: str  # Name of the producer.
    epoch: int  # Positive number, which the producer changes when `seq` restarts at 0.
    seq: int  # Offset of the message in this epoch.
    stamp_ns: int  # Stamp of the message.
    key: str = ""  # Value of the field that `Topic.key` names, for `Latest(per_key=True)`.

    def __post_init__(self) -> None:
        if not (0 <= self.seq < MAX_SEQ and self.epoch > 0):
            raise ValueError(
                f"header epoch={self.epoch} must be positive, and header seq={self.seq} must be "
                "within 0..2^62-1"
            )


# Header of messages that other programs send without one.
EXTERNAL_HEADER = Header("outside", 1, 0, 0)


class ConsumerHello(msgspec.Struct, frozen=True, tag="join", array_like=True):
    """Handshake message from a consumer to a producer."""

    consumer: str
    has_backlog: bool = False  # True: the producer does not wait for the consumer's credit.
    nonce: int = 0  # Random number, which the producer repeats in its hello.


class Credit(msgspec.Struct, frozen=True, tag="grant", array_like=True):
    """Position and credit of a consumer, sent to the producer."""

    consumer: str
    epoch: int  # Epoch of the producer.
    handled: int  # Offset of the first message that is not handled.
    arrived: int  # Offset of the first message that has not arrived.
    limit: int  # Offset of the first message that may not be sent yet.
    gap: bool = False  # The producer should retransmit from message `arrived` on.
    # The consumer takes no messages because its disk is full. The producer must not evict it.
    waits_for_disk: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.handled <= self.arrived < MAX_SEQ or self.limit < self.handled:
            raise ValueError(
                f"credit handled={self.handled}, arrived={self.arrived}, limit={self.limit} must "
                "satisfy 0 <= handled <= arrived and handled <= limit"
            )


class ProducerHello(msgspec.Struct, frozen=True, array_like=True):
    """Handshake message from a producer to its consumers."""

    epoch: int  # Epoch of the producer.
    starts: dict[str, int]  # Offset of the first message for each known consumer, by name.
    # Last nonce of each consumer; None: the producer is of a version without nonces.
    nonces: dict[str, int] | None = None

    def __post_init__(self) -> None:
        if self.epoch <= 0:
            raise ValueError(f"hello epoch={self.epoch} must be positive")
        for start in self.starts.values():
            if not 0 <= start < MAX_SEQ:
                raise ValueError(
                    f"hello names the offset {start} for the first message of a consumer; an "
                    "offset must be within 0..2^62-1"
                )


class UnackedMessage(NamedTuple):
    """Numbered message that at least one consumer has not handled."""

    seq: int  # Offset of the message.
    header: bytes  # Encoded `Header`.
    body: bytes  # Encoded message.


class OutletPosition(NamedTuple):
    """Saved position of a producer on a topic, with its unhandled messages."""

    epoch: int  # Epoch of the producer's numbering.
    seq: int  # Offset of the next message.
    # Messages that at least one required consumer has not handled; empty if a log has them.
    unhandled: tuple[UnackedMessage, ...] = ()
    # Offset of the first message that is still needed, if the messages are in a log on disk
    # instead of in `unhandled`; None without a log.
    logged_from: int | None = None

    @property
    def handled(self) -> int:
        """Offset of the first message that a consumer may still need; `seq` if there is none."""
        if self.logged_from is not None:
            return self.logged_from
        return self.unhandled[0].seq if self.unhandled else self.seq


class InletPosition(NamedTuple):
    """Saved position of a consumer on a topic."""

    epoch: int  # Epoch of the producer; 0: no producer was connected.
    handled: int  # Offset of the first message that is not handled.


def new_epoch() -> int:
    """Return a new random epoch, which identifies one numbering of a producer's messages."""
    return 1 + secrets.randbits(62)


def new_nonce() -> int:
    """Return a new random number for the hello of a consumer."""
    return 1 + secrets.randbits(62)


encode_link = msgspec.msgpack.Encoder().encode


def decode_request(body: memoryview) -> ConsumerHello | Credit:
    """Decode the hello or the credit of a consumer."""
    return decode(body, ConsumerHello | Credit)  # type: ignore[arg-type]


def data_key(topic: str) -> str:
    """Return the key on which the messages of a topic are published."""
    return topic


def retransmit_key(topic: str, consumer: str = "") -> str:
    """Return the key of retransmitted messages.

    Only lossless consumers subscribe to this key, so other consumers get no message twice.

    Args:
        topic: Name of the topic.
        consumer: Name of a consumer with policy `Backlog`. Each such consumer has its own key, so
            that no other consumer receives its backlog. If the name is empty, the result is the key
            that all other lossless consumers share.
    """
    return f"link/again/{topic}/{consumer}" if consumer else f"link/again/{topic}"


def credit_key(topic: str) -> str:
    """Return the key on which consumers send hello and credit messages to the producer."""
    return f"link/grant/{topic}"


def producer_hello_key(topic: str) -> str:
    """Return the key on which the producer of a topic sends its hello."""
    return f"link/welcome/{topic}"


class SequenceTracker:
    """Counter of lost messages of a topic.

    A message that arrives late does not count as lost. A repeated message changes no count: a
    restarted producer repeats messages that a consumer may not have received. The sequence numbers
    come from other programs, so the count is limited to the range of an int64.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._producer: tuple[str, int] = ("", 0)  # Name and epoch of the last message.
        self._next = 0  # Offset of the next message of that producer.
        self._missing: dict[int, None] = {}  # Offsets of missing messages, in order.

    def observe(self, header: Header) -> bool:
        """Count the messages lost before a message; return False if the message is repeated."""
        if (header.source, header.epoch) != self._producer:
            self._producer, self._next = (header.source, header.epoch), header.seq
            self._missing.clear()
        if header.seq < self._next:
            return self._came_late(header.seq)
        if header.seq - self._next > MAX_JUMP:
            self._next = header.seq
            self._missing.clear()
        self.add_lost(header.seq - self._next)
        missed = range(max(self._next, header.seq - MAX_MISSING), header.seq)
        self._missing |= dict.fromkeys(missed)
        while len(self._missing) > MAX_MISSING:
            del self._missing[next(iter(self._missing))]
        self._next = header.seq + 1
        return True

    def add_lost(self, count: int) -> None:
        """Count lost messages; the count stops at the largest int64."""
        self.lost = min(self.lost + count, LAST_INTEGER)

    def _came_late(self, seq: int) -> bool:
        if seq not in self._missing:
            return False
        del self._missing[seq]
        self.lost -= 1
        return True
