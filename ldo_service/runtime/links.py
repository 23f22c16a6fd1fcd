"""A link from a producer to a lossless consumer, over a network that may lose messages.

    Join      consumer -> producer   "I am here"; repeated until welcomed
    Welcome   producer -> consumer   "numbering starts at n, in my epoch e"
    Grant     consumer -> producer   "I have handled all before h, all before a has arrived, and I
                                     take up to n": absolute, so it may be lost, repeated or
                                     reordered; sent after each step and twice a second

The producer keeps what was not handled, at most one window, and sends it again from `arrived` when
a grant shows a gap. A consumer that died and joined again is welcomed at what it had not handled.
"""

import msgspec

MAX_SEQ = 1 << 62


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


class Join(msgspec.Struct, frozen=True, tag="join", array_like=True):
    consumer: str


class Grant(msgspec.Struct, frozen=True, tag="grant", array_like=True):
    consumer: str
    epoch: int
    handled: int  # every seq below is done with
    arrived: int  # every seq below has arrived
    limit: int  # the first seq that may not be sent yet
    gap: bool = False  # `arrived` was sent and did not arrive


class Welcome(msgspec.Struct, frozen=True, array_like=True):
    consumer: str
    epoch: int
    start: int  # the first seq to come


encode = msgspec.msgpack.Encoder().encode
decode_header = msgspec.msgpack.Decoder(Header).decode
decode_request = msgspec.msgpack.Decoder(Join | Grant).decode
decode_welcome = msgspec.msgpack.Decoder(Welcome).decode


def data_key(topic: str) -> str:
    return topic


def grant_key(topic: str) -> str:
    return f"link/grant/{topic}"


def welcome_key(topic: str) -> str:
    return f"link/welcome/{topic}"
