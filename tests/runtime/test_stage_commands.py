"""Tests of the commands pause, resume, reset and save of a stage, also on a lossy network."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from ldo_service.runtime import Actor, In, Latest, Lossless, Out, stage_commands
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import COMMAND_KEY, CommandSender, StageCommand
from ldo_service.schemas import Message, decode
from ldo_service.schemas import encode as encode_message
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import FolderStore, State
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
    """An actor that publishes the number of messages so far; it saves only on request."""

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


async def test_paused_stage_drops_and_counts_messages() -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen, policy=Latest(2))
    sender = CommandSender(transport)

    def deliver(*values: int) -> None:
        for value in values:
            transport.deliver(
                NUMBERS.name, encode_link(EXTERNAL_HEADER), encode_message(number(value))
            )

    async with running(stage):
        deliver(1)
        await eventually(lambda: seen == [1])
        assert await sender.send("pause", "collector", 60) == ""
        assert stage.health().paused
        deliver(2, 3, 4)
        assert await sender.send("resume", "collector", 60) == ""
        deliver(5)
        await eventually(lambda: seen == [1, 5] and stage.health().inputs[0].delivered == 2)
        (counted,) = stage.health().inputs
        assert (counted.dropped_paused, counted.dropped) == (3, 0)
        assert not stage.health().paused


async def test_paused_stage_keeps_messages_of_a_lossless_input() -> None:
    transport, seen = MemoryTransport(), []
    stage, sender = collector(transport, seen), CommandSender(transport)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, {"collector"})
    async with running(stage):
        await sender.send("pause", "collector", 60)
        for value in range(4):
            await send(numbers, number(value))
        waiting = asyncio.create_task(send(numbers, number(4)))
        await asyncio.sleep(0.05)
        assert (seen, waiting.done()) == ([], False)
        await sender.send("resume", "collector", 60)
        await eventually(lambda: seen == [0, 1, 2, 3, 4])
        await waiting


async def test_pause_waits_for_the_current_step() -> None:
    transport, seen, release = MemoryTransport(), [], Event()
    stage = collector(transport, seen, lambda _value: release.wait(60) and None, policy=Latest(1))
    sender = CommandSender(transport)
    async with running(stage):
        transport.deliver(NUMBERS.name, encode_link(EXTERNAL_HEADER), encode_message(number(1)))
        await eventually(lambda: stage.health().state == "busy")
        pausing = asyncio.create_task(sender.send("pause", "collector", 60))
        await asyncio.sleep(0.05)
        assert not pausing.done()
        release.set()
        assert await pausing == ""
        assert seen == [1]


async def test_busy_stage_keeps_its_state_once_for_all_waiting_commands() -> None:
    transport, seen, release = MemoryTransport(), [], Event()
    stage = collector(transport, seen, lambda _value: release.wait(60) and None, policy=Latest(1))
    sender = CommandSender(transport)
    async with running(stage):
        transport.deliver(NUMBERS.name, encode_link(EXTERNAL_HEADER), encode_message(number(1)))
        await eventually(lambda: stage.health().state == "busy")
        answers = [
            asyncio.create_task(sender.send("keep", "collector", 60, (number, 0)))
            for number in range(1, 6)
        ]
        await eventually(lambda: sum(answer.done() for answer in answers) == 4)
        release.set()
        assert [await answer for answer in answers] == ["was replaced by a newer command"] * 4 + [
            ""
        ]
        assert seen == [1]


async def test_soft_stop_ends_a_paused_stage() -> None:
    transport, seen = MemoryTransport(), []
    stage, sender = collector(transport, seen), CommandSender(transport)
    async with running(stage) as (task,):
        await sender.send("pause", "collector", 60)
        stage.drain()
        await asyncio.wait_for(task, 60)


async def test_reset_stage_starts_empty_and_its_consumer_continues() -> None:
    transport, seen, store = MemoryTransport(), [], MemoryStore()
    expected = {NUMBERS.name: frozenset({"collector"})}
    counter = Stage(Counter, transport, config=QUICK, store=store, expected=expected)
    sender = CommandSender(transport)
    async with running(counter, collector(transport, seen)):
        feed(transport, 10)
        await eventually(lambda: seen == [1])
        feed(transport, 11)
        await eventually(lambda: seen == [1, 2])
        await sender.send("save", "counter", 60)
        epoch = counter.health().epoch
        for command in ("pause", "reset", "resume"):
            assert await sender.send(command, "counter", 5) == ""
        assert counter.health().epoch != epoch
        assert RestoredState.of(store.load("counter")).own == {}
        feed(transport, 12)
        await eventually(lambda: seen == [1, 2, 1])
        feed(transport, 13)
        await eventually(lambda: seen == [1, 2, 1, 2])


async def test_reset_consumer_reconnects_to_its_producer() -> None:
    transport, seen = MemoryTransport(), []
    stage, sender = collector(transport, seen), CommandSender(transport)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, {"collector"})
    async with running(stage):
        await send(numbers, number(0))
        await eventually(lambda: seen == [0])
        assert await sender.send("reset", "collector", 60) == ""
        for value in range(1, 9):
            await send(numbers, number(value))
        await eventually(lambda: seen == list(range(9)))


async def test_messages_from_before_a_reset_are_not_handled() -> None:
    transport, seen = MemoryTransport(), []
    doubles = DoubleCollector(seen)
    stage, sender = Stage(lambda: doubles, transport, config=QUICK), CommandSender(transport)
    old = Outlet(Out(DOUBLES), "source", 7, transport)
    async with running(stage):
        await eventually(lambda: "double_collector" in old._consumers)
        await sender.send("pause", "double_collector", 60)
        await send(old, Double(stamp_ns=1, value=1))
        old.reset(8)
        await sender.send("reset", "double_collector", 60)
        await sender.send("resume", "double_collector", 60)
        await eventually(lambda: old.credits() == 2)
        await send(old, Double(stamp_ns=2, value=2))
        await eventually(lambda: seen == [2])


async def test_query_returns_no_value_from_before_a_reset() -> None:
    transport = MemoryTransport()
    outlet = Outlet(Out(LATEST_NUMBER), "me", 1, transport)
    await send(outlet, number(1))
    assert transport.query(LATEST_NUMBER.name)
    outlet.reset(2)
    assert not transport.query(LATEST_NUMBER.name)


async def test_save_command_writes_a_full_checkpoint(tmp_path: Path) -> None:
    transport, store = MemoryTransport(), FolderStore(tmp_path)
    counter = Stage(Counter, transport, config=QUICK, store=store)
    sender = CommandSender(transport)
    async with running(counter):
        feed(transport, 1)
        await eventually(lambda: counter.health().steps == 1)
        assert FolderStore(tmp_path).load("counter") is None
        assert await sender.send("save", "counter", 60) == ""
        assert FolderStore(tmp_path).load("counter") == {"count": 1}
        store.delete("counter")
        assert FolderStore(tmp_path).load("counter") is None
        assert list((tmp_path / "counter").iterdir()) == []
        assert await sender.send("save", "counter", 60) == ""
        assert FolderStore(tmp_path).load("counter") == {"count": 1}


async def test_failed_save_is_reported_and_the_stage_continues(tmp_path: Path) -> None:
    transport = MemoryTransport()
    counter = Stage(Counter, transport, config=QUICK, store=FolderStore(tmp_path))
    (tmp_path / "counter").write_text("a file where the folder should be")
    async with running(counter):
        assert "FileExistsError" in await CommandSender(transport).send("save", "counter", 60)
        feed(transport, 1)
        await eventually(lambda: counter.health().steps == 1)


async def test_command_runs_once_although_commands_and_replies_are_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stage_commands, "REPEAT_AFTER_S", 0.01)
    losses = iter([True, True, False, True, True, False, True] + [False] * 1000)
    transport = MemoryTransport(lose=lambda key: "link/" in key and next(losses))
    counter, sender = Stage(Counter, transport, config=QUICK), CommandSender(transport)
    epochs = [counter.health().epoch]
    async with running(counter):
        assert await sender.send("reset", "counter", 60) == ""
        epochs.append(counter.health().epoch)
        await asyncio.sleep(0.05)
        assert counter.health().epoch == epochs[1] != epochs[0]


async def test_late_command_of_a_sender_does_not_undo_a_newer_one() -> None:
    transport, seen = MemoryTransport(), []
    stage, sender = collector(transport, seen), CommandSender(transport)
    sent: list[bytes] = []
    transport.subscribe(COMMAND_KEY, lambda _, body: sent.append(bytes(body)))
    async with running(stage):
        assert await sender.send("resume", "absent", 0.01) != ""
        late = StageCommand(decode(sent[0], StageCommand).number, "pause", "collector")
        assert await sender.send("resume", "collector", 60) == ""
        transport.deliver(COMMAND_KEY, b"", encode_link(late))
        await asyncio.sleep(0.01)
        assert not stage.health().paused
        assert await CommandSender(transport).send("pause", "collector", 60) == ""
        assert stage.health().paused


async def test_missing_reply_is_reported() -> None:
    sender = CommandSender(MemoryTransport())
    assert await sender.send("pause", "absent", 0.01) == "did not answer within 0 s"


async def test_malformed_commands_are_ignored() -> None:
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
