"""A link from a producer to a lossless consumer, over a network that may lose messages.

    Join      consumer -> producer   "I am here"; repeated until welcomed
    Welcome   producer -> consumers  "in my epoch e, what you get begins at n", for all it knows;
                                     each answers at once, with a Join or a Grant
    Grant     consumer -> producer   "I have handled all before h, all before a has arrived, and I
                                     take up to n"; after each step and twice a second

All three state what is, not what changed: they may be lost, repeated or replaced by newer ones.

The producer keeps what was not handled, at most one window, and sends it again from `arrived` when
a grant shows a gap. A consumer that died and joined again gets what it had not handled. Both ends
keep their place beside the actor's state (`ledger`), in one write with it: so each message takes
effect once, whoever is killed, and when.
"""

from typing import NamedTuple

import msgspec

from ldo_service.schemas import decode

MAX_SEQ = 1 << 62
ALIVE = "link/alive"  # tokens of the actors that are there


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


OUTSIDE = Header("outside", 1, 0, 0)  # of a message that a foreign program sends without one


class Join(msgspec.Struct, frozen=True, tag="join", array_like=True):
    consumer: str


class Grant(msgspec.Struct, frozen=True, tag="grant", array_like=True):
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


class Welcome(msgspec.Struct, frozen=True, array_like=True):
    epoch: int
    starts: dict[str, int]  # by consumer: the first seq to come


class Sent(NamedTuple):
    """A message that was numbered."""

    seq: int
    header: bytes
    body: bytes


class OutletPast(NamedTuple):
    """Where a producer stood, and what some consumer had not handled."""

    epoch: int
    seq: int  # of the next message
    unhandled: tuple[Sent, ...] = ()

    @property
    def handled(self) -> int:
        """Every message before has been handled."""
        return self.unhandled[0].seq if self.unhandled else self.seq


class InletPast(NamedTuple):
    """Where a consumer stood."""

    epoch: int  # of its producer; 0: none was known
    handled: int


encode_link = msgspec.msgpack.Encoder().encode


def decode_request(body: memoryview) -> Join | Grant:
    return decode(body, Join | Grant)  # type: ignore[arg-type]


def data_key(topic: str) -> str:
    return topic


def again_key(topic: str) -> str:
    """Repetitions go to lossless consumers only: others see each message once."""
    return f"link/again/{topic}"


def grant_key(topic: str) -> str:
    return f"link/grant/{topic}"


def welcome_key(topic: str) -> str:
    return f"link/welcome/{topic}"
