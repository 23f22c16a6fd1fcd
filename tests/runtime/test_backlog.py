"""Tests of inputs with a backlog: the producer never waits, and nothing is lost or repeated."""

import asyncio
import random
import time
from collections.abc import Iterable
from pathlib import Path
from threading import Event

import pytest

from ldo_service.runtime.actor import Backlog, In, Lossless, Out
from ldo_service.runtime.inlet import Delivery, LosslessInlet
from ldo_service.runtime.outbox import Outbox
from ldo_service.runtime.outlet import Outlet
from ldo_service.schemas import encode
from ldo_service.storage import message_log
from ldo_service.storage.message_log import MessageLog
from ldo_service.transport.flow_control import (
    Header,
    OutletPosition,
    credit_key,
    data_key,
    producer_hello_key,
    retransmit_key,
)
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import NUMBERS, collector, eventually, number, running, send

LARGE = 1_000_000_000
LOSSY_KEYS = [
    *(key(NUMBERS.name) for key in (data_key, retransmit_key, credit_key, producer_hello_key)),
    retransmit_key(NUMBERS.name, "slow"),
]


def logged_outlet(
    transport: MemoryTransport,
    folder: Path,
    past: OutletPosition | None = None,
    *,
    expected: Iterable[str] = ("slow",),
    max_bytes: int = LARGE,
) -> Outlet:
    past = past or OutletPosition(5, 0)
    log = MessageLog(folder, past.epoch, past.handled, past.seq, max_bytes=max_bytes)
    return Outlet(
        Out(NUMBERS), "producer", past.epoch, transport, expected, past=past,
        with_backlog=("slow",), outbox=Outbox(log=log),
    )  # fmt: skip


async def send_saved(source: Outlet, values: Iterable[int]) -> None:
    """Send numbers as a stage does: each is stored before it is sent."""
    for value in values:
        source.stage_message(number(value), b"")
        source.rollback()  # A failed step does so; the number is used again.
        source.stage_message(number(value), encode(number(value)))
        source.store()
        await source.commit()


async def test_producer_does_not_wait_for_a_slow_consumer_that_receives_all(
    tmp_path: Path,
) -> None:
    transport, seen, release = MemoryTransport(), [], Event()
    source = logged_outlet(transport, tmp_path)
    slow = collector(
        transport, seen, lambda _: release.wait(60) and None, policy=Backlog(4), name="slow"
    )
    async with running(slow):
        await send_saved(source, range(100))
        assert source.sent == 100
        assert source.credits() > 1000
        await eventually(lambda: slow.health().current_step_s > 0)
        assert source.counts().behind == {"slow": 100}
        assert source.counts().backlog_mb > 0
        release.set()
        await eventually(lambda: len(seen) == 100)
        await eventually(lambda: source.counts().behind == {"slow": 0})
    assert seen == list(range(100))
    assert slow.health().inputs[0].gaps == 0
    assert list(tmp_path.iterdir()) == []


async def test_slow_consumer_does_not_delay_a_lossless_one(tmp_path: Path) -> None:
    transport, seen, slow_seen, release = MemoryTransport(), [], [], Event()
    source = logged_outlet(transport, tmp_path, expected=("slow", "collector"))
    slow = collector(
        transport, slow_seen, lambda _: release.wait(60) and None, policy=Backlog(2), name="slow"
    )
    async with running(slow, collector(transport, seen, policy=Lossless(4))):
        await send_saved(source, range(50))
        await eventually(lambda: len(seen) == 50)
        assert slow_seen == []
        release.set()
        await eventually(lambda: len(slow_seen) == 50)
    assert seen == slow_seen == list(range(50))


@pytest.mark.parametrize("seed", range(4))
async def test_lossy_network_with_restarts_delivers_each_message_once_in_order(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 200)
    rng = random.Random(seed)
    transport = MemoryTransport(lose=lambda key: key in LOSSY_KEYS and rng.random() < 0.3)
    seen: list[int] = []
    slow = collector(transport, seen, policy=Backlog(3), name="slow")
    async with running(slow):
        source = logged_outlet(transport, tmp_path)
        for start in range(0, 120, 20):
            await send_saved(source, range(start, start + 20))
            await asyncio.sleep(rng.random() * 0.02)
            past = source.position()
            source.close()
            source = logged_outlet(transport, tmp_path, past)  # A new process continues.
        await eventually(lambda: len(seen) >= 120)
    assert seen == list(range(120))
    source.close()


async def test_consumer_that_was_dead_receives_the_backlog_after_its_restart(
    tmp_path: Path,
) -> None:
    transport, seen = MemoryTransport(), []
    source = logged_outlet(transport, tmp_path)
    await send_saved(source, range(30))
    assert source.sent == 30
    async with running(collector(transport, seen, policy=Backlog(4), name="slow")):
        await eventually(lambda: len(seen) == 30)
    assert seen == list(range(30))


async def test_consumer_skips_what_the_maximum_size_dropped_and_counts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 200)
    transport, seen = MemoryTransport(), []
    source = logged_outlet(transport, tmp_path, max_bytes=1000)
    await send_saved(source, range(100))
    dropped = source.counts().backlog_dropped
    assert dropped > 50
    slow = collector(transport, seen, policy=Backlog(4), name="slow")
    async with running(slow):
        await eventually(lambda: seen and seen[-1] == 99)
    assert seen == list(range(dropped, 100))


async def test_connected_consumer_that_falls_behind_the_maximum_size_counts_the_loss(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 200)
    transport, seen, release = MemoryTransport(), [], Event()
    source = logged_outlet(transport, tmp_path, max_bytes=1000)
    slow = collector(
        transport, seen, lambda _: release.wait(60) and None, policy=Backlog(4), name="slow"
    )
    async with running(slow):
        await send_saved(source, range(10))
        await eventually(lambda: slow.health().current_step_s > 0)
        await send_saved(source, range(10, 100))
        release.set()
        await eventually(lambda: seen and seen[-1] == 99)
        lost = slow.health().inputs[0].lost
    assert lost == 100 - len(seen) > 0
    assert seen == sorted(set(seen))


async def test_consumer_with_a_backlog_is_never_evicted(tmp_path: Path) -> None:
    transport, release, evicted = MemoryTransport(), Event(), []
    log = MessageLog(tmp_path, 5, 0, 0, max_bytes=LARGE)
    source = Outlet(
        Out(NUMBERS), "producer", 5, transport, ("slow",), 0.01, evicted.append,
        with_backlog=("slow",), outbox=Outbox(log=log),
    )  # fmt: skip
    slow = collector(
        transport, [], lambda _: release.wait(60) and None, policy=Backlog(4), name="slow"
    )
    async with running(slow):
        await send_saved(source, range(10))
        await eventually(lambda: slow.health().current_step_s > 0)
        source.evict_stalled(time.monotonic())
        await asyncio.sleep(0.05)
        source.evict_stalled(time.monotonic())
        assert evicted == []
        release.set()


async def test_backlog_in_memory_is_bounded() -> None:
    transport, seen = MemoryTransport(), []
    source = Outlet(
        Out(NUMBERS), "producer", 5, transport, ("slow",),
        with_backlog=("slow",), outbox=Outbox(max_bytes=500),
    )  # fmt: skip
    for value in range(100):
        await send(source, number(value))
    assert source.counts().backlog_dropped > 50
    assert source.counts().backlog_mb <= 500e-6
    async with running(collector(transport, seen, policy=Backlog(4), name="slow")):
        await eventually(lambda: seen and seen[-1] == 99)
    assert seen == list(range(seen[0], 100))


async def test_message_damaged_on_disk_is_skipped_and_counted(tmp_path: Path) -> None:
    transport, seen = MemoryTransport(), []
    source = logged_outlet(transport, tmp_path)
    await send_saved(source, range(30))
    (path,) = tmp_path.iterdir()
    raw = bytearray(path.read_bytes())
    raw[raw.index(encode(number(15))) + 2] ^= 1
    path.write_bytes(raw)
    slow = collector(transport, seen, policy=Backlog(4), name="slow")
    async with running(slow):
        await eventually(lambda: seen and seen[-1] == 29)
        assert slow.health().inputs[0].lost == 1
    assert len(seen) == 29
    assert seen == sorted(set(seen))


@pytest.mark.parametrize("name", ["slow", "collector"])
async def test_end_of_the_log_lost_in_a_power_cut_stalls_no_consumer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 200)
    transport, seen = MemoryTransport(), []
    source = logged_outlet(transport, tmp_path, expected=(name,))
    for value in range(20):
        source.stage_message(number(value), encode(number(value)))
    source.store()
    past = source.position()
    source.close()
    *_, newest = sorted(tmp_path.iterdir())
    newest.unlink()
    source = logged_outlet(transport, tmp_path, past, expected=(name,))
    policy = Backlog(4) if name == "slow" else Lossless(4)
    stage = collector(transport, seen, policy=policy, name=name)
    async with running(stage):
        await eventually(lambda: len(seen) >= 10)
        await send_saved(source, [20])
        await eventually(lambda: seen[-1] == 20)
        lost = stage.health().inputs[0].lost
    assert lost == 21 - len(seen) > 0
    assert seen == sorted(set(seen))


async def test_queued_messages_before_a_hole_are_handled_again_after_a_kill() -> None:
    inlet = LosslessInlet(In(NUMBERS, Backlog(4)))
    inlet.welcome(5, 0, inlet.nonce)
    deliveries = [
        Delivery(inlet.port, Header("producer", 5, seq, 0), memoryview(b"")) for seq in (0, 1, 2)
    ]
    for delivery in deliveries:
        assert inlet.accept(delivery.header)
        inlet.offer(delivery)
    assert inlet.welcome(5, 200, 0) == 197
    assert inlet.position(None).handled == 0
    for delivery in deliveries:
        inlet.waiting.popleft()
        inlet.done(delivery, rejected=False)
    assert inlet.position(None).handled == 200
