"""Flow control between a producer and its lossless consumers, over a lossy network.

    Join      consumer -> producer   "I am here"; repeated until welcomed
    Welcome   producer -> consumers  "in my epoch e, your messages begin at n", as far as it knows;
                                     each answers at once, with a Join or a Grant
    Grant     consumer -> producer   "I have handled all before h, all before a has arrived, and I
                                     take up to n"; after each step and twice a second

All three state what is, not what changed: they may be lost, repeated or replaced by newer ones.

The producer keeps the messages that were not handled, at most one window, and sends them again from
`arrived` when a grant shows a gap. A consumer that died and joined again gets what it had not
handled. Both ends keep their position beside the actor's state (`runtime.delivery_state`), in one
write with it: so each message takes effect once, whichever process is killed, and when.
`SequenceTracker` follows the sequence numbers that a producer gave to the messages of a topic.
"""

import secrets
from typing import NamedTuple

import msgspec

from ldo_service.schemas import decode

MAX_SEQ = 1 << 62
ALIVE = "link/alive"  # tokens of the actors that are there

MAX_MISSING = 1024  # numbers that may come late yet: half a minute of a camera


class Header(msgspec.Struct, frozen=True, array_like=True):
    """Rides beside each body, so that foreign programs can decode the body directly."""

    source: str
    epoch: int  # changes when the producer starts anew, and with it the numbering
    seq: int
    stamp_ns: int
    key: str = ""

    def __post_init__(self) -> None:
        if not (0 <= self.seq < MAX_SEQ and self.epoch > 0):
            raise ValueError(f"header with epoch {self.epoch}, seq {self.seq}")


# of a message that a foreign program sends without one
EXTERNAL_HEADER = Header("outside", 1, 0, 0)


class ConsumerHello(msgspec.Struct, frozen=True, tag="join", array_like=True):
    consumer: str


class Credit(msgspec.Struct, frozen=True, tag="grant", array_like=True):
    consumer: str
    epoch: int
    handled: int  # every seq below is done with
    arrived: int  # every seq below has arrived
    limit: int  # the first seq that may not be sent yet
    gap: bool = False  # `arrived` was sent and did not arrive
    waits_for_disk: bool = False  # it takes nothing until its disk does, and is not to be evicted

    def __post_init__(self) -> None:
        if not 0 <= self.handled <= self.arrived < MAX_SEQ or self.limit < self.handled:
            raise ValueError(f"impossible grant {self.handled}, {self.arrived}, {self.limit}")


class ProducerHello(msgspec.Struct, frozen=True, array_like=True):
    epoch: int
    starts: dict[str, int]  # by consumer: the first seq to come


class UnackedMessage(NamedTuple):
    """A message that was numbered."""

    seq: int
    header: bytes
    body: bytes


class OutletPosition(NamedTuple):
    """Where a producer stood, and what some consumer had not handled."""

    epoch: int
    seq: int  # of the next message
    unhandled: tuple[UnackedMessage, ...] = ()

    @property
    def handled(self) -> int:
        """Every message before has been handled."""
        return self.unhandled[0].seq if self.unhandled else self.seq


class InletPosition(NamedTuple):
    """Where a consumer stood."""

    epoch: int  # of its producer; 0: none was known
    handled: int


def new_epoch() -> int:
    """Return a number that no earlier run of a producer had."""
    return 1 + secrets.randbits(62)


encode_link = msgspec.msgpack.Encoder().encode


def decode_request(body: memoryview) -> ConsumerHello | Credit:
    return decode(body, ConsumerHello | Credit)  # type: ignore[arg-type]


def data_key(topic: str) -> str:
    return topic


def retransmit_key(topic: str) -> str:
    """Repetitions go to lossless consumers only: others see each message once."""
    return f"link/again/{topic}"


def credit_key(topic: str) -> str:
    return f"link/grant/{topic}"


def producer_hello_key(topic: str) -> str:
    return f"link/welcome/{topic}"


class SequenceTracker:
    """How many never came. One that comes late after all is none of them, one that comes again
    neither: a producer that was started again repeats what some consumer may not have had."""

    def __init__(self) -> None:
        self.lost = 0
        self._producer: tuple[str, int] = ("", 0)  # name and epoch of who sent the last one
        self._next = 0  # number of that producer
        self._missing: dict[int, None] = {}  # in order

    def observe(self, header: Header) -> bool:
        """Take note of a message; False: it came before."""
        if (header.source, header.epoch) != self._producer:
            self._producer, self._next = (header.source, header.epoch), header.seq
            self._missing.clear()
        if header.seq < self._next:
            return self._came_late(header.seq)
        self.lost += header.seq - self._next
        missed = range(max(self._next, header.seq - MAX_MISSING), header.seq)
        self._missing |= dict.fromkeys(missed)
        while len(self._missing) > MAX_MISSING:
            del self._missing[next(iter(self._missing))]
        self._next = header.seq + 1
        return True

    def _came_late(self, seq: int) -> bool:
        if seq not in self._missing:
            return False
        del self._missing[seq]
        self.lost -= 1
        return True
