"""Lossless links: over a network that loses messages, past consumers and producers that die."""

import asyncio
import random
from itertools import pairwise
from threading import Event

import pytest

from ldo_service.runtime.actor import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import SupervisionConfig
from ldo_service.transport.flow_control import (
    OutletPosition,
    credit_key,
    data_key,
    producer_hello_key,
    retransmit_key,
)
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import NUMBERS, collector, eventually, number, running, send

KEYS = [key(NUMBERS.name) for key in (data_key, retransmit_key, credit_key, producer_hello_key)]


def outlet(transport: MemoryTransport, *expected: str, epoch: int = 1, **options: float) -> Outlet:
    return Outlet(Out(NUMBERS), "producer", epoch, transport, expected, **options)


async def test_a_slow_consumer_gets_everything_in_order_within_its_window() -> None:
    transport, seen, let_go = MemoryTransport(), [], Event()
    stage = collector(transport, seen, lambda _value: let_go.wait(60) and None)
    source = outlet(transport, "collector")

    async def produce() -> None:
        for value in range(50):
            await send(source, number(value))

    async with running(stage):
        producing = asyncio.create_task(produce())
        await eventually(lambda: source.credits() == 0 and source.sent == 4)
        await asyncio.sleep(0.05)
        assert source.sent == 4  # not one more than the window, however long it takes
        let_go.set()
        await producing
        await eventually(lambda: stage.health().inputs[0].delivered == 50)
        counted = stage.health().inputs[0]
    assert seen == list(range(50))
    assert (counted.delivered, counted.dropped, counted.queued) == (50, 0, 0)
    assert counted.peak_queued <= 4
    assert source.counts().backpressure_waits >= 1


@pytest.mark.parametrize("seed", range(5))
async def test_a_network_that_loses_a_third_still_delivers_each_message_once_in_order(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    chance = random.Random(seed)
    transport = MemoryTransport(lose=lambda key: key in KEYS and chance.random() < 0.33)
    one, other = [], []
    source = outlet(transport, "one", "other")
    stages = collector(transport, one, name="one"), collector(transport, other, name="other")
    async with running(*stages):
        for value in range(60):
            await send(source, number(value))
        await source.flush()
        await eventually(lambda: len(one) == len(other) == 60)
    assert one == other == list(range(60))
    assert source.counts().retransmitted > 0


@pytest.mark.parametrize("seed", range(4))
async def test_a_consumer_that_dies_again_and_again_on_a_bad_network_misses_nothing(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    chance = random.Random(seed)
    transport = MemoryTransport(lose=lambda key: key in KEYS and chance.random() < 0.2)
    source, lives = outlet(transport, "collector"), []

    async def produce() -> None:
        for value in range(80):
            await send(source, number(value))

    producing = asyncio.create_task(produce())
    while not lives or lives[-1][-1:] != [79]:
        lives.append([])
        life, length = lives[-1], chance.randint(1, 30)
        async with running(collector(transport, life)):
            await eventually(lambda life=life, n=length: len(life) >= n or life[-1:] == [79])
        transport.leave("collector")
    await producing
    for life in lives:
        assert life == list(range(life[0], life[0] + len(life)))
    for before, after in pairwise(lives):
        assert after[0] <= before[-1] + 1  # nothing is left out between two lives


async def test_a_consumer_that_waits_is_found_as_soon_as_the_producer_starts() -> None:
    transport, seen = MemoryTransport(), []
    patient = SupervisionConfig(heartbeat_s=1000)
    async with running(collector(transport, seen, config=patient)):
        source = outlet(transport, "collector")
        await send(source, number(0))
        await eventually(lambda: seen == [0])


async def test_everyone_else_sees_a_repeated_message_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    dropped: list[str] = []

    def lose_the_second(key: str) -> bool:
        if key == data_key(NUMBERS.name):
            dropped.append(key)
        return key == data_key(NUMBERS.name) and len(dropped) == 2

    transport = MemoryTransport(lose=lose_the_second)
    seen: list[int] = []
    overheard: list[bytes] = []
    transport.subscribe(data_key(NUMBERS.name), lambda _header, body: overheard.append(bytes(body)))
    source = outlet(transport, "collector")
    async with running(collector(transport, seen)):
        for value in range(6):
            await send(source, number(value))
        await eventually(lambda: len(seen) == 6)
    assert seen == list(range(6))
    assert len(overheard) == len(set(overheard)) == 5


async def test_a_consumer_nobody_expects_releases_the_window_when_it_dies() -> None:
    transport, stuck = MemoryTransport(), Event()
    source = outlet(transport)
    async with running(collector(transport, [], lambda _value: stuck.wait(60) and None)):
        await eventually(lambda: source.credits() == 4)
        for value in range(4):
            await send(source, number(value))
        waiting = asyncio.create_task(send(source, number(4)))
        await asyncio.sleep(0.02)
        assert not waiting.done()
        transport.leave("collector")
        await waiting
        stuck.set()


async def test_an_expected_consumer_that_died_gets_what_it_had_not_handled() -> None:
    transport, first, second, stuck = MemoryTransport(), [], [], Event()
    source = outlet(transport, "collector")

    def hang_at_two(value: int) -> None:
        if value == 2:
            stuck.wait(60)
            raise RuntimeError("this process is dead")

    async with running(collector(transport, first, hang_at_two)):
        for value in range(6):
            await send(source, number(value))
        await eventually(lambda: first == [0, 1])
    transport.leave("collector")
    assert source.credits() == 0
    stuck.set()
    async with running(collector(transport, second)):
        await eventually(lambda: second == [2, 3, 4, 5] and source.credits() == 4)
        await send(source, number(6))
        await eventually(lambda: second == [2, 3, 4, 5, 6])


async def test_before_the_expected_consumer_has_joined_there_is_no_room() -> None:
    transport, seen = MemoryTransport(), []
    source = outlet(transport, "collector")
    assert source.credits() == 0
    sending = asyncio.create_task(send(source, number(0)))
    await asyncio.sleep(0.01)
    assert not sending.done()
    async with running(collector(transport, seen)):
        await sending
        await eventually(lambda: seen == [0])


async def test_a_topic_without_lossless_consumers_is_never_waited_for() -> None:
    source = outlet(MemoryTransport())
    for value in range(100):
        await send(source, number(value))
    assert source.counts().backpressure_waits == 0


async def test_a_producer_that_starts_anew_is_followed_from_its_first_message() -> None:
    transport, seen = MemoryTransport(), []
    first = outlet(transport, "collector", epoch=7)
    async with running(collector(transport, seen)):
        for value in range(5):
            await send(first, number(value))
        await first.flush()
        first.close()
        second = outlet(transport, "collector", epoch=3)  # epochs need not ascend
        for value in range(5, 10):
            await send(second, number(value))
        await eventually(lambda: len(seen) == 10)
    assert seen == list(range(10))


async def test_flush_returns_when_the_last_message_has_arrived(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    lossy = {"now": False}
    transport = MemoryTransport(lose=lambda key: lossy["now"] and key == data_key(NUMBERS.name))
    seen: list[int] = []
    source = outlet(transport, "collector")
    stage = collector(transport, seen)
    async with running(stage):
        await send(source, number(0))
        lossy["now"] = True
        await send(source, number(1))  # the tail gets lost, and nothing follows that shows a gap
        await source.flush()
        stage.drain()
        await eventually(lambda: seen == [0, 1])


async def test_a_living_consumer_that_takes_nothing_is_evicted_and_returns_when_it_moves() -> None:
    transport, seen, stuck, evicted = MemoryTransport(), [], Event(), []
    source = Outlet(
        Out(NUMBERS), "producer", 1, transport, (), evict_after_s=0.05, on_evicted=evicted.append
    )
    async with running(collector(transport, seen, lambda _value: stuck.wait(60) and None)):
        await eventually(lambda: source.credits() == 4)
        for value in range(4):
            await send(source, number(value))
        sending = asyncio.create_task(send(source, number(4)))

        def check() -> bool:
            source.evict_stalled()
            return sending.done()

        await eventually(check)
        for value in range(5, 30):
            await send(source, number(value))  # its heartbeats alone do not let it hold us up again
        assert evicted == ["collector"]
        stuck.set()
        await eventually(lambda: source.credits() == 4)
        await send(source, number(99))
        await eventually(lambda: seen[-1:] == [99])
    assert seen[:4] == [0, 1, 2, 3]
    assert seen == sorted(seen)


async def test_bytes_that_are_no_grant_or_welcome_are_left_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    transport, seen = MemoryTransport(), []
    source = outlet(transport, "collector")
    async with running(collector(transport, seen)):
        for noise in (b"", b"\xff\x00", b"\x92\x01\x80", b"\x91" * 5000):
            transport.deliver(credit_key(NUMBERS.name), b"", noise)
            transport.deliver(producer_hello_key(NUMBERS.name), b"", noise)
        await send(source, number(0))
        await eventually(lambda: seen == [0])
    assert "malformed handshake" in caplog.text
    assert "malformed credit message" in caplog.text


async def test_a_producer_older_than_its_consumer_says_what_to_do(caplog) -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen)
    source = outlet(transport, "collector")
    async with running(stage):
        for value in range(3):
            await send(source, number(value))
        await eventually(lambda: len(seen) == 3)
        source.close()
        older = Outlet(
            Out(NUMBERS), "producer", 9, transport, ("collector",), past=OutletPosition(1, 1)
        )
        await eventually(lambda: "ldo control reset" in caplog.text)
        assert older.credits() == 0
    assert caplog.text.count("collector has received 3 messages, but only 1 were sent") == 1
