"""Stages are held, released, renewed and saved between two steps, even on a bad network."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime import stage_commands as orders_module
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import COMMAND_KEY, CommandSender, StageCommand
from ldo_service.schemas import Message
from ldo_service.schemas import encode as encode_message
from ldo_service.storage.state_store import FolderStore, MemoryStore, State
from ldo_service.transport.flow_control import EXTERNAL_HEADER, encode_link
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import (
    DOUBLES,
    LATEST_NUMBER,
    NUMBERS,
    QUICK,
    Double,
    DoubleCollector,
    collector,
    eventually,
    number,
    running,
    send,
)


class Counter(Actor):
    """Numbers what it sees from 1, and passes the number on."""

    name = "counter"
    inputs = (In(LATEST_NUMBER, Latest(4)),)
    outputs = (Out(NUMBERS),)

    def __init__(self) -> None:
        super().__init__()
        self._count = 0
        self.lazily_saved: State = {}

    def handle(self, message: Message) -> Iterator[Message]:  # noqa: ARG002
        self._count += 1
        yield number(self._count)

    def snapshot(self) -> State:
        return self.lazily_saved

    def checkpoint(self) -> State:
        self.lazily_saved = {"count": self._count}
        return self.snapshot()

    def restore(self, state: State) -> None:
        self._count = state["count"]


def feed(transport: MemoryTransport, *values: int) -> None:
    for value in values:
        transport.deliver(
            LATEST_NUMBER.name, encode_link(EXTERNAL_HEADER), encode_message(number(value))
        )


async def test_a_held_stage_leaves_out_what_comes_and_counts_it() -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen, policy=Latest(2))
    commander = CommandSender(transport)

    def arrive(*values: int) -> None:
        for value in values:
            transport.deliver(
                NUMBERS.name, encode_link(EXTERNAL_HEADER), encode_message(number(value))
            )

    async with running(stage):
        arrive(1)
        await eventually(lambda: seen == [1])
        assert await commander.order("pause", "collector", 60) == ""
        assert stage.health().paused
        arrive(2, 3, 4)
        assert await commander.order("resume", "collector", 60) == ""
        arrive(5)
        await eventually(lambda: seen == [1, 5] and stage.health().inputs[0].delivered == 2)
        (counted,) = stage.health().inputs
        assert (counted.dropped_paused, counted.dropped) == (3, 0)
        assert not stage.health().paused


async def test_a_held_stage_loses_nothing_of_a_lossless_input() -> None:
    transport, seen = MemoryTransport(), []
    stage, commander = collector(transport, seen), CommandSender(transport)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, {"collector"})
    async with running(stage):
        await commander.order("pause", "collector", 60)
        for value in range(4):
            await send(numbers, number(value))
        waiting = asyncio.create_task(send(numbers, number(4)))
        await asyncio.sleep(0.05)
        assert (seen, waiting.done()) == ([], False)
        await commander.order("resume", "collector", 60)
        await eventually(lambda: seen == [0, 1, 2, 3, 4])
        await waiting


async def test_a_hold_waits_for_the_step_under_way() -> None:
    transport, seen, go = MemoryTransport(), [], Event()
    stage = collector(transport, seen, lambda _value: go.wait(60) and None, policy=Latest(1))
    commander = CommandSender(transport)
    async with running(stage):
        transport.deliver(NUMBERS.name, encode_link(EXTERNAL_HEADER), encode_message(number(1)))
        await eventually(lambda: stage.health().state == "busy")
        holding = asyncio.create_task(commander.order("pause", "collector", 60))
        await asyncio.sleep(0.05)
        assert not holding.done()
        go.set()
        assert await holding == ""
        assert seen == [1]


async def test_a_soft_stop_ends_a_held_stage() -> None:
    transport, seen = MemoryTransport(), []
    stage, commander = collector(transport, seen), CommandSender(transport)
    async with running(stage) as (task,):
        await commander.order("pause", "collector", 60)
        stage.drain()
        await asyncio.wait_for(task, 60)


async def test_a_renewed_stage_begins_anew_and_its_consumer_follows() -> None:
    transport, seen, store = MemoryTransport(), [], MemoryStore()
    expected = {NUMBERS.name: frozenset({"collector"})}
    counter = Stage(Counter, transport, config=QUICK, store=store, expected=expected)
    commander = CommandSender(transport)
    async with running(counter, collector(transport, seen)):
        feed(transport, 10)
        await eventually(lambda: seen == [1])
        feed(transport, 11)
        await eventually(lambda: seen == [1, 2])
        await commander.order("save", "counter", 60)
        epoch = counter.health().epoch
        for what in ("pause", "reset", "resume"):
            assert await commander.order(what, "counter", 5) == ""
        assert counter.health().epoch != epoch
        assert RestoredState.of(store.load("counter")).own == {}
        feed(transport, 12)
        await eventually(lambda: seen == [1, 2, 1])
        feed(transport, 13)
        await eventually(lambda: seen == [1, 2, 1, 2])


async def test_a_renewed_consumer_joins_its_producer_again() -> None:
    transport, seen = MemoryTransport(), []
    stage, commander = collector(transport, seen), CommandSender(transport)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, {"collector"})
    async with running(stage):
        await send(numbers, number(0))
        await eventually(lambda: seen == [0])
        assert await commander.order("reset", "collector", 60) == ""
        for value in range(1, 9):
            await send(numbers, number(value))
        await eventually(lambda: seen == list(range(9)))


async def test_nothing_of_the_time_before_is_handled_after_a_renewal() -> None:
    transport, seen = MemoryTransport(), []
    doubles = DoubleCollector(seen)
    stage, commander = Stage(lambda: doubles, transport, config=QUICK), CommandSender(transport)
    old = Outlet(Out(DOUBLES), "source", 7, transport)
    async with running(stage):
        await eventually(lambda: "double_collector" in old._consumers)
        await commander.order("pause", "double_collector", 60)
        await send(old, Double(stamp_ns=1, value=1))
        old.reset(8)
        await commander.order("reset", "double_collector", 60)
        await commander.order("resume", "double_collector", 60)
        await eventually(lambda: old.credits() == 2)
        await send(old, Double(stamp_ns=2, value=2))
        await eventually(lambda: seen == [2])


async def test_a_last_value_of_the_time_before_is_not_given_to_who_asks() -> None:
    transport = MemoryTransport()
    outlet = Outlet(Out(LATEST_NUMBER), "me", 1, transport)
    await send(outlet, number(1))
    assert transport.query(LATEST_NUMBER.name)
    outlet.reset(2)
    assert not transport.query(LATEST_NUMBER.name)


async def test_a_save_writes_what_the_actor_had_left_for_later(tmp_path: Path) -> None:
    transport, store = MemoryTransport(), FolderStore(tmp_path)
    counter = Stage(Counter, transport, config=QUICK, store=store)
    commander = CommandSender(transport)
    async with running(counter):
        feed(transport, 1)
        await eventually(lambda: counter.health().steps == 1)
        assert FolderStore(tmp_path).load("counter") is None
        assert await commander.order("save", "counter", 60) == ""
        assert FolderStore(tmp_path).load("counter") == {"count": 1}
        store.delete("counter")
        assert FolderStore(tmp_path).load("counter") is None
        assert list((tmp_path / "counter").iterdir()) == []
        assert await commander.order("save", "counter", 60) == ""
        assert FolderStore(tmp_path).load("counter") == {"count": 1}


async def test_a_save_that_fails_is_reported_and_the_stage_goes_on(tmp_path: Path) -> None:
    transport = MemoryTransport()
    counter = Stage(Counter, transport, config=QUICK, store=FolderStore(tmp_path))
    (tmp_path / "counter").write_text("a file where the folder should be")
    async with running(counter):
        assert "FileExistsError" in await CommandSender(transport).order("save", "counter", 60)
        feed(transport, 1)
        await eventually(lambda: counter.health().steps == 1)


async def test_an_order_is_obeyed_once_though_orders_and_reports_get_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(orders_module, "REPEAT_AFTER_S", 0.01)
    losses = iter([True, True, False, True, True, False, True] + [False] * 1000)
    transport = MemoryTransport(lose=lambda key: "link/" in key and next(losses))
    counter, commander = Stage(Counter, transport, config=QUICK), CommandSender(transport)
    epochs = [counter.health().epoch]
    async with running(counter):
        assert await commander.order("reset", "counter", 60) == ""
        epochs.append(counter.health().epoch)
        await asyncio.sleep(0.05)
        assert counter.health().epoch == epochs[1] != epochs[0]


async def test_who_does_not_answer_is_said() -> None:
    commander = CommandSender(MemoryTransport())
    assert await commander.order("pause", "nobody", 0.01) == "did not answer within 0 s"


async def test_bytes_that_are_no_order_are_left_alone() -> None:
    transport, seen = MemoryTransport(), []
    async with running(collector(transport, seen, policy=Lossless(4))):
        for body in (
            b"",
            b"\xc1",
            encode_link(("x", 1)),
            encode_link(StageCommand(1, "pause", "another")),
        ):
            transport.deliver(COMMAND_KEY, b"", body)
        await asyncio.sleep(0.01)
