"""Tests of the mailbox: inputs of policy Latest and messages of other programs."""

import asyncio

import pytest

from ldo_service import __version__
from ldo_service.runtime import In, Latest, Lossless, Out
from ldo_service.runtime.inlet import MAX_PROMPT_REPLIES, Delivery, LosslessInlet
from ldo_service.runtime.mailbox import Mailbox
from ldo_service.runtime.outlet import Outlet
from ldo_service.schemas import encode as encode_message
from ldo_service.schemas.message import LAST_INTEGER
from ldo_service.schemas.topics import LABEL_ADD, MAP_REFINE, ODOMETRY_PRIOR, Topic
from ldo_service.transport.flow_control import (
    ConsumerHello,
    Credit,
    Header,
    ProducerHello,
    SequenceTracker,
    credit_key,
    decode_request,
    encode_link,
    producer_hello_key,
)
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import DOUBLES, NUMBERS, collector, eventually, number, running


class Feed:
    """A producer without flow control."""

    def __init__(self, transport: MemoryTransport, topic: str = NUMBERS.name) -> None:
        self._transport, self._topic, self._seq = transport, topic, 0
        self.epoch = 1

    def send(self, value: int, key: str = "") -> None:
        header = Header("feed", self.epoch, self._seq, value, key)
        self._seq += 1
        body = encode_message(number(value, region=key))
        self._transport.deliver(self._topic, encode_link(header), body)


async def take_all(mailbox: Mailbox) -> list[tuple[str, int]]:
    """Return the key and stamp of all queued messages."""
    mailbox.close()
    taken: list[Delivery] = []
    while delivery := await mailbox.take():
        taken.append(delivery)
        mailbox.done(delivery)
    return [(delivery.header.key, delivery.header.stamp_ns) for delivery in taken]


async def test_latest_drops_and_counts_the_oldest() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(2)),), transport)
    feed = Feed(transport)
    for value in range(10):
        feed.send(value)
    assert await take_all(mailbox) == [("", 8), ("", 9)]
    (counted,) = mailbox.counts()
    assert (counted.delivered, counted.dropped, counted.peak_queued, counted.queued) == (2, 8, 2, 0)


async def test_priority_input_is_taken_first_and_in_order() -> None:
    transport = MemoryTransport()
    ports = In(NUMBERS, Latest(8)), In(DOUBLES, Latest(8), has_priority=True)
    mailbox = Mailbox("me", ports, transport)
    normal, urgent = Feed(transport), Feed(transport, DOUBLES.name)
    for value in range(3):
        normal.send(value)
        urgent.send(10 + value)
    assert [stamp for _, stamp in await take_all(mailbox)] == [10, 11, 12, 0, 1, 2]
    assert [counted.delivered for counted in mailbox.counts()] == [3, 3]


async def test_latest_per_key_keeps_the_newest_of_each_key() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(1, per_key=True)),), transport)
    feed = Feed(transport)
    for value, key in enumerate("aabcab"):
        feed.send(value, key)
    assert await take_all(mailbox) == [("c", 3), ("a", 4), ("b", 5)]
    assert mailbox.counts()[0].dropped == 3


async def test_exceeding_max_keys_drops_the_longest_waiting_key() -> None:
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


async def test_unreadable_header_is_rejected_and_counted() -> None:
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


async def test_latest_input_accepts_messages_without_header() -> None:
    transport, seen = MemoryTransport(), []
    async with running(collector(transport, seen, policy=Latest(4))):
        transport.deliver(NUMBERS.name, b"", encode_message(number(5)))
        await eventually(lambda: seen == [5])


async def test_flooded_lossless_input_queues_only_its_window() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Lossless(3)),), transport)
    sent: list[memoryview] = []
    transport.subscribe(credit_key(NUMBERS.name), lambda _, body: sent.append(body))
    mailbox.send_credits()
    asked = decode_request(sent[0])
    assert isinstance(asked, ConsumerHello)
    hello = encode_link(ProducerHello(1, {"me": 0}, {"me": asked.nonce}))
    transport.deliver(producer_hello_key(NUMBERS.name), b"", hello)
    feed = Feed(transport)
    for value in range(100):
        feed.send(value)
    (counted,) = mailbox.counts()
    assert (counted.queued, counted.peak_queued) == (3, 3)
    assert await take_all(mailbox) == [("", 0), ("", 1), ("", 2)]


async def test_producer_without_nonces_is_named_once_and_is_not_asked_without_pause(
    caplog: pytest.LogCaptureFixture,
) -> None:
    transport, hellos = MemoryTransport(), 0
    answer = encode_link([1, {"me": 0}])  # A hello of the version before nonces.

    def reply(_header: bytes, body: memoryview) -> None:
        nonlocal hellos
        if isinstance(decode_request(body), ConsumerHello):
            hellos += 1
            transport.deliver(producer_hello_key(NUMBERS.name), b"", answer)

    transport.subscribe(credit_key(NUMBERS.name), reply)
    mailbox = Mailbox("me", (In(NUMBERS, Lossless(3)),), transport)
    for _ in range(100):
        await asyncio.sleep(0)
    assert hellos == 1 + MAX_PROMPT_REPLIES
    for _ in range(5):  # Heartbeats.
        mailbox.send_credits()
        for _ in range(10):
            await asyncio.sleep(0)
    assert hellos == 6 + MAX_PROMPT_REPLIES
    (warning,) = [record.getMessage() for record in caplog.records]
    assert "the actor that produces test/number is of an older version" in warning
    assert f"version {__version__}" in warning
    nonce = mailbox._inlets[NUMBERS.name].nonce  # type: ignore[attr-defined]
    answer = encode_link(ProducerHello(2, {"me": 0}, {"me": nonce}))  # It is updated.
    transport.deliver(producer_hello_key(NUMBERS.name), b"", answer)
    feed = Feed(transport)
    feed.epoch = 2
    feed.send(5)
    assert await take_all(mailbox) == [("", 5)]


async def test_undecodable_body_is_rejected_and_the_next_is_handled() -> None:
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


async def test_oversized_message_is_rejected_before_decoding(caplog) -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(4)),), transport, max_bytes=100)
    transport.deliver(NUMBERS.name, b"", bytes(101))
    transport.deliver(NUMBERS.name, b"", bytes(100))  # It is malformed, but not yet decoded.
    (counted,) = mailbox.counts()
    assert (counted.rejected, counted.queued) == (1, 1)
    assert "101 bytes exceed service.max_decoded_message_mb=0.0001. Raise" in caplog.text


async def test_rejections_are_logged_once_per_episode_and_each_counted(caplog) -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen, policy=Latest(8))
    good, bad = encode_message(number(3)), b"\x80"
    async with running(stage):
        for body in (bad, bad, good, bad):
            transport.deliver(NUMBERS.name, b"", body)
        await eventually(lambda: stage.health().inputs[0].rejected == 3)
    assert len([r for r in caplog.records if "rejected" in r.message]) == 2


async def test_foreign_sequence_numbers_keep_the_lost_count_within_an_int64() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(4)),), transport)
    for epoch in range(1, 6):
        for seq in (0, 2**62 - 1):
            header = encode_link(Header("outside", epoch, seq, 0))
            transport.deliver(NUMBERS.name, header, encode_message(number(0)))
    assert mailbox.counts()[0].lost == 0, "an impossible jump is a new numbering"
    tracker = SequenceTracker()
    tracker.lost = LAST_INTEGER - 1
    for seq in (0, 5):
        tracker.observe(Header("outside", 1, seq, 0))
    assert tracker.lost == LAST_INTEGER
    mailbox.disconnect()


async def test_long_header_is_rejected() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(4)),), transport)
    header = encode_link(Header("x" * 8_000_000, 1, 0, 0))
    transport.deliver(NUMBERS.name, header, encode_message(number(0)))
    assert mailbox.counts()[0].rejected == 1
    mailbox.disconnect()


async def test_lost_messages_are_counted_from_sequence_numbers() -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(64)),), transport)

    def lost_after(epoch: int, *numbers: int) -> int:
        for seq in numbers:
            header = encode_link(Header("source", epoch, seq, 0))
            transport.deliver(NUMBERS.name, header, encode_message(number(seq)))
        return mailbox.counts()[0].lost

    assert lost_after(1, 5, 6, 7) == 0, "messages before the first one are not lost"
    assert lost_after(1, 10) == 2
    assert lost_after(1, 9) == 1, "the message was only late"
    assert lost_after(1, 9, 10, 7) == 1, "repeated messages do not count"
    assert lost_after(2, 0, 1, 3) == 2, "a new epoch is counted separately"
    transport.deliver(NUMBERS.name, b"", encode_message(number(0)))
    assert mailbox.counts()[0].lost == 2, "messages without header have no number"
    mailbox.disconnect()


async def test_queued_messages_are_bounded_by_bytes_and_the_largest_input_gives_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ldo_service.runtime.mailbox.MAX_WAITING_BYTES", 10_000)
    transport = MemoryTransport()
    ports = (In(NUMBERS, Latest(64)), In(DOUBLES, Latest(64)))
    mailbox = Mailbox("me", ports, transport)
    transport.deliver(DOUBLES.name, b"", bytes(100))
    for _ in range(50):
        transport.deliver(NUMBERS.name, b"", bytes(4000))
    numbers, doubles = mailbox.counts()
    assert (numbers.queued, numbers.dropped) == (2, 48)
    assert (doubles.queued, doubles.dropped) == (1, 0)
    assert len(mailbox._order) == 3
    mailbox.disconnect()


async def test_single_message_may_exceed_the_limit_of_queued_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ldo_service.runtime.mailbox.MAX_WAITING_BYTES", 10_000)
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Latest(64)), In(DOUBLES, Latest(64))), transport)
    for _ in range(3):
        transport.deliver(NUMBERS.name, b"", bytes(20_000))
    numbers, _ = mailbox.counts()
    assert (numbers.queued, numbers.dropped) == (1, 2)
    mailbox.disconnect()


@pytest.mark.parametrize("topic", [ODOMETRY_PRIOR, LABEL_ADD, MAP_REFINE])
async def test_message_larger_than_its_topic_allows_is_rejected(topic: Topic) -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(topic, Latest(64)),), transport)
    transport.deliver(topic.name, b"", bytes(65_536))
    transport.deliver(topic.name, b"", bytes(65_537))
    (counted,) = mailbox.counts()
    assert (counted.queued, counted.rejected) == (1, 1)
    mailbox.disconnect()


def test_late_hello_of_an_earlier_run_does_not_make_an_input_handle_a_message_twice() -> None:
    inlet = LosslessInlet(In(NUMBERS, Lossless(4)))
    inlet.welcome(1, 0, old := inlet.nonce)
    inlet.reset()
    inlet.welcome(2, 0, inlet.nonce)
    delivery = Delivery(inlet.port, Header("producer", 2, 0, 0), memoryview(b""))
    assert inlet.accept(delivery.header)
    inlet.welcome(1, 0, old)
    assert isinstance(inlet.grant("consumer"), ConsumerHello)
    inlet.done(delivery, rejected=False)
    inlet.welcome(2, 0, inlet.nonce)
    assert inlet.position(None).handled == 1
    assert not inlet.accept(delivery.header)


def test_input_connects_to_an_earlier_epoch_whose_producer_answers_its_hello() -> None:
    inlet = LosslessInlet(In(NUMBERS, Lossless(4)))
    for epoch in (1, 2, 1):
        inlet.welcome(epoch, 0, 0)
        hello = inlet.grant("consumer")
        assert isinstance(hello, ConsumerHello)
        inlet.welcome(epoch, 0, hello.nonce)
        credit = inlet.grant("consumer")
        assert isinstance(credit, Credit)
        assert credit.epoch == epoch


async def test_malformed_handshakes_and_credits_write_one_line_a_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    transport = MemoryTransport()
    mailbox = Mailbox("me", (In(NUMBERS, Lossless(2)),), transport)
    outlet = Outlet(Out(DOUBLES), "me", 1, transport)
    for _ in range(50):
        transport.deliver(producer_hello_key(NUMBERS.name), b"", b"noise")
        transport.deliver(credit_key(DOUBLES.name), b"", b"noise")
    lines = [record.getMessage() for record in caplog.records]
    assert [line.partition(":")[0] for line in lines] == ["me", DOUBLES.name]
    mailbox.disconnect()
    outlet.close()
