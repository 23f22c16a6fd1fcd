"""Inputs of policy Latest, and what arrives from outside."""

from ldo_service.runtime import In, Latest, Lossless
from ldo_service.runtime.inlet import Delivery
from ldo_service.runtime.mailbox import Mailbox
from ldo_service.schemas import encode as encode_message
from ldo_service.transport.flow_control import Header, encode_link
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import DOUBLES, NUMBERS, collector, eventually, number, running


class Feed:
    """A producer without a link: what it sends, it sends."""

    def __init__(self, transport: MemoryTransport, topic: str = NUMBERS.name) -> None:
        self._transport, self._topic, self._seq = transport, topic, 0

    def send(self, value: int, key: str = "") -> None:
        header = Header("feed", 1, self._seq, value, key)
        self._seq += 1
        body = encode_message(number(value, region=key))
        self._transport.deliver(self._topic, encode_link(header), body)


async def take_all(mailbox: Mailbox) -> list[tuple[str, int]]:
    """Key and stamp of all that waits."""
    mailbox.close()
    taken: list[Delivery] = []
    while delivery := await mailbox.take():
        taken.append(delivery)
        mailbox.done(delivery)
    return [(delivery.header.key, delivery.header.stamp_ns) for delivery in taken]


async def test_latest_drops_the_oldest_and_counts() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(2)),), transport)
    feed = Feed(transport)
    for value in range(10):
        feed.send(value)
    assert await take_all(mailbox) == [("", 8), ("", 9)]
    (counted,) = mailbox.counts()
    assert (counted.delivered, counted.dropped, counted.peak_queued, counted.queued) == (2, 8, 2, 0)


async def test_what_goes_first_is_taken_before_all_that_waits_and_in_its_own_order() -> None:
    transport = MemoryTransport()
    ports = In(NUMBERS, Latest(8)), In(DOUBLES, Latest(8), has_priority=True)
    mailbox = Mailbox("me", ports, transport)
    patient, hasty = Feed(transport), Feed(transport, DOUBLES.name)
    for value in range(3):
        patient.send(value)
        hasty.send(10 + value)
    assert [stamp for _, stamp in await take_all(mailbox)] == [10, 11, 12, 0, 1, 2]
    assert [counted.delivered for counted in mailbox.counts()] == [3, 3]


async def test_latest_per_key_keeps_the_newest_of_each() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(1, per_key=True)),), transport)
    feed = Feed(transport)
    for value, key in enumerate("aabcab"):
        feed.send(value, key)
    assert await take_all(mailbox) == [("c", 3), ("a", 4), ("b", 5)]
    assert mailbox.counts()[0].dropped == 3


async def test_beyond_max_keys_the_key_that_waited_longest_makes_room() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(2, per_key=True, max_keys=2)),), transport)
    feed = Feed(transport)
    for value, key in enumerate(["a", "a", "b", "c"]):
        feed.send(value, key)
    assert await take_all(mailbox) == [("b", 2), ("c", 3)]
    assert mailbox.counts()[0].dropped == 2


async def test_inputs_are_merged_in_order_of_arrival() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(8)), In(DOUBLES, Latest(8))), transport)
    numbers, doubles = Feed(transport), Feed(transport, DOUBLES.name)
    for value in range(6):
        (numbers if value % 3 else doubles).send(value)
    assert await take_all(mailbox) == [("", value) for value in range(6)]


async def test_a_message_whose_header_cannot_be_read_is_rejected_and_counted() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(8)), In(DOUBLES, Lossless(2))), transport)
    for noise in (
        b"\xff",
        b"\x96\xa1a\x01\x00\x00\xa0" + b"\x91" * 9999,
        encode_link(["feed", 0, 0, 0]),
        encode_link(["feed", 1, -1, 0]),
    ):
        transport.deliver(NUMBERS.name, noise, b"")
        transport.deliver(DOUBLES.name, noise, b"")
    assert await take_all(mailbox) == []
    assert [counted.rejected for counted in mailbox.counts()] == [4, 4]


async def test_a_foreign_program_may_send_to_a_latest_input_without_a_header() -> None:
    transport, seen = MemoryTransport(), []
    async with running(collector(transport, seen, policy=Latest(4))):
        transport.deliver(NUMBERS.name, b"", encode_message(number(5)))
        await eventually(lambda: seen == [5])


async def test_a_flood_into_a_lossless_input_stays_within_its_window() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Lossless(3)),), transport)
    transport.deliver("link/welcome/test/number", b"", encode_link([1, {"me": 0}]))
    feed = Feed(transport)
    for value in range(100):
        feed.send(value)
    (counted,) = mailbox.counts()
    assert (counted.queued, counted.peak_queued) == (3, 3)
    assert await take_all(mailbox) == [("", 0), ("", 1), ("", 2)]


async def test_a_body_that_does_not_decode_is_rejected_and_the_next_is_handled() -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen, policy=Latest(8))
    async with running(stage):
        transport.deliver(NUMBERS.name, b"", b"\x80")
        transport.deliver(NUMBERS.name, b"", b"\x81\xa1y" + b"\x91" * 100_000)
        transport.deliver(NUMBERS.name, b"", encode_message(number(3)))
        await eventually(lambda: seen == [3])
        await eventually(lambda: stage.health().inputs[0].delivered == 1)
        assert stage.health().inputs[0].rejected == 2
        assert stage.health().failures == 0


async def test_a_message_over_the_size_limit_is_rejected_before_it_is_decoded() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(4)),), transport, max_bytes=100)
    transport.deliver(NUMBERS.name, b"", bytes(101))
    transport.deliver(NUMBERS.name, b"", bytes(100))  # no message either, but that shows later
    (counted,) = mailbox.counts()
    assert (counted.rejected, counted.queued) == (1, 1)


async def test_rejections_are_said_once_an_episode_and_counted_each(caplog) -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen, policy=Latest(8))
    good, bad = encode_message(number(3)), b"\x80"
    async with running(stage):
        for body in (bad, bad, good, bad):
            transport.deliver(NUMBERS.name, b"", body)
        await eventually(lambda: stage.health().inputs[0].rejected == 3)
    assert len([r for r in caplog.records if "rejected" in r.message]) == 2


async def test_what_never_came_is_counted_by_the_numbers_of_what_did() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(64)),), transport)

    def arrives(epoch: int, *numbers: int) -> int:
        for seq in numbers:
            header = encode_link(Header("source", epoch, seq, 0))
            transport.deliver(NUMBERS.name, header, encode_message(number(seq)))
        return mailbox.counts()[0].lost

    assert arrives(1, 5, 6, 7) == 0, "who comes late has lost nothing"
    assert arrives(1, 10) == 2
    assert arrives(1, 9) == 1, "it was only late"
    assert arrives(1, 9, 10, 7) == 1, "these came again"
    assert arrives(2, 0, 1, 3) == 2, "another producer counts anew"
    transport.deliver(NUMBERS.name, b"", encode_message(number(0)))
    assert mailbox.counts()[0].lost == 2, "a foreign program numbers nothing"
    mailbox.disconnect()
