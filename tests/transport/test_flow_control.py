"""Tests of lossless links over a lossy network, with consumers and producers that end."""

import asyncio
import random
import time
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


async def test_slow_consumer_receives_all_in_order_within_its_window() -> None:
    transport, seen, release = MemoryTransport(), [], Event()
    stage = collector(transport, seen, lambda _value: release.wait(60) and None)
    source = outlet(transport, "collector")

    async def produce() -> None:
        for value in range(50):
            await send(source, number(value))

    async with running(stage):
        producing = asyncio.create_task(produce())
        await eventually(lambda: source.credits() == 0 and source.sent == 4)
        await asyncio.sleep(0.05)
        assert source.sent == 4  # The producer sends at most the window.
        release.set()
        await producing
        await eventually(lambda: stage.health().inputs[0].delivered == 50)
        counted = stage.health().inputs[0]
    assert seen == list(range(50))
    assert (counted.delivered, counted.dropped, counted.queued) == (50, 0, 0)
    assert counted.peak_queued <= 4
    assert source.counts().backpressure_waits >= 1


@pytest.mark.parametrize("seed", range(5))
async def test_lossy_network_delivers_each_message_once_in_order(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    rng = random.Random(seed)
    transport = MemoryTransport(lose=lambda key: key in KEYS and rng.random() < 0.33)
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
async def test_repeatedly_killed_consumer_on_lossy_network_misses_nothing(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    rng = random.Random(seed)
    transport = MemoryTransport(lose=lambda key: key in KEYS and rng.random() < 0.2)
    source, runs = outlet(transport, "collector"), []

    async def produce() -> None:
        for value in range(80):
            await send(source, number(value))

    producing = asyncio.create_task(produce())
    while not runs or runs[-1][-1:] != [79]:
        runs.append([])
        run, length = runs[-1], rng.randint(1, 30)
        async with running(collector(transport, run)):
            await eventually(lambda run=run, n=length: len(run) >= n or run[-1:] == [79])
        transport.leave("collector")
    await producing
    for run in runs:
        assert run == list(range(run[0], run[0] + len(run)))
    for before, after in pairwise(runs):
        assert after[0] <= before[-1] + 1  # Consecutive runs leave no gap.


async def test_waiting_consumer_is_found_when_the_producer_starts() -> None:
    transport, seen = MemoryTransport(), []
    config = SupervisionConfig(heartbeat_s=1000)
    async with running(collector(transport, seen, config=config)):
        source = outlet(transport, "collector")
        await send(source, number(0))
        await eventually(lambda: seen == [0])


async def test_other_subscribers_receive_a_retransmitted_message_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    dropped: list[str] = []

    def lose_the_second(key: str) -> bool:
        if key == data_key(NUMBERS.name):
            dropped.append(key)
        return key == data_key(NUMBERS.name) and len(dropped) == 2

    transport = MemoryTransport(lose=lose_the_second)
    seen: list[int] = []
    received: list[bytes] = []
    transport.subscribe(data_key(NUMBERS.name), lambda _header, body: received.append(bytes(body)))
    source = outlet(transport, "collector")
    async with running(collector(transport, seen)):
        for value in range(6):
            await send(source, number(value))
        await eventually(lambda: len(seen) == 6)
    assert seen == list(range(6))
    assert len(received) == len(set(received)) == 5


async def test_unexpected_consumer_releases_the_window_when_it_ends() -> None:
    transport, release = MemoryTransport(), Event()
    source = outlet(transport)
    async with running(collector(transport, [], lambda _value: release.wait(60) and None)):
        await eventually(lambda: source.credits() == 4)
        for value in range(4):
            await send(source, number(value))
        waiting = asyncio.create_task(send(source, number(4)))
        await asyncio.sleep(0.02)
        assert not waiting.done()
        transport.leave("collector")
        await waiting
        release.set()


async def test_restarted_expected_consumer_receives_unhandled_messages() -> None:
    transport, first, second, release = MemoryTransport(), [], [], Event()
    source = outlet(transport, "collector")

    def hang_at_two(value: int) -> None:
        if value == 2:
            release.wait(60)
            raise RuntimeError("injected failure of the consumer")

    async with running(collector(transport, first, hang_at_two)):
        for value in range(6):
            await send(source, number(value))
        await eventually(lambda: first == [0, 1])
    transport.leave("collector")
    assert source.credits() == 0
    release.set()
    async with running(collector(transport, second)):
        await eventually(lambda: second == [2, 3, 4, 5] and source.credits() == 4)
        await send(source, number(6))
        await eventually(lambda: second == [2, 3, 4, 5, 6])


async def test_producer_has_no_credit_before_the_expected_consumer_joins() -> None:
    transport, seen = MemoryTransport(), []
    source = outlet(transport, "collector")
    assert source.credits() == 0
    sending = asyncio.create_task(send(source, number(0)))
    await asyncio.sleep(0.01)
    assert not sending.done()
    async with running(collector(transport, seen)):
        await sending
        await eventually(lambda: seen == [0])


async def test_topic_without_lossless_consumers_causes_no_backpressure() -> None:
    source = outlet(MemoryTransport())
    for value in range(100):
        await send(source, number(value))
    assert source.counts().backpressure_waits == 0


async def test_restarted_producer_is_received_from_its_first_message() -> None:
    transport, seen = MemoryTransport(), []
    first = outlet(transport, "collector", epoch=7)
    async with running(collector(transport, seen)):
        for value in range(5):
            await send(first, number(value))
        await first.flush()
        first.close()
        second = outlet(transport, "collector", epoch=3)  # Epochs need not increase.
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
        await send(source, number(1))  # The last message is lost, and no later one reveals the gap.
        await source.flush()
        stage.drain()
        await eventually(lambda: seen == [0, 1])


async def test_stalled_consumer_is_evicted_and_returns_when_it_continues() -> None:
    transport, seen, release, evicted = MemoryTransport(), [], Event(), []
    source = Outlet(
        Out(NUMBERS), "producer", 1, transport, (), evict_after_s=0.05, on_evicted=evicted.append
    )
    async with running(collector(transport, seen, lambda _value: release.wait(60) and None)):
        await eventually(lambda: source.credits() == 4)
        for value in range(4):
            await send(source, number(value))
        sending = asyncio.create_task(send(source, number(4)))

        def check() -> bool:
            source.evict_stalled(time.monotonic())
            return sending.done()

        await eventually(check)
        for value in range(5, 30):
            # Heartbeats alone do not let the evicted consumer block the producer again.
            await send(source, number(value))
        assert evicted == ["collector"]
        release.set()
        await eventually(lambda: source.credits() == 4)
        await send(source, number(99))
        await eventually(lambda: seen[-1:] == [99])
    assert seen[:4] == [0, 1, 2, 3]
    assert seen == sorted(seen)


@pytest.mark.parametrize("lost", [KEYS[:2], KEYS], ids=["messages", "messages and credits"])
async def test_link_continues_after_a_loss_that_lasted_until_the_eviction(lost: list[str]) -> None:
    is_losing = False
    transport = MemoryTransport(lose=lambda key: is_losing and key in lost)
    seen: list[int] = []
    source = Outlet(Out(NUMBERS), "producer", 1, transport, ("collector",), evict_after_s=0.05)
    async with running(collector(transport, seen)):
        await eventually(lambda: source.credits() == 4)
        is_losing = True
        for value in range(4):
            await send(source, number(value))

        def is_evicted() -> bool:
            source.evict_stalled(time.monotonic())
            return source.evicted > 0

        await eventually(is_evicted)
        is_losing = False
        await eventually(lambda: seen == [0, 1, 2, 3])
        await eventually(lambda: source.credits() == 4)


async def test_malformed_credits_and_handshakes_are_ignored(
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


async def test_producer_older_than_its_consumer_logs_the_remedy(caplog) -> None:
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
