"""Tests of the delivery state of a stage: each message takes effect once, also after a kill."""

import asyncio
from collections.abc import Iterable, Iterator
from pathlib import Path
from random import Random
from typing import cast

import pytest

from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.delivery_state import (
    MAX_WAL_ENTRIES,
    LoggedInput,
    RestoredState,
    restore_actor,
)
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage, new_epoch
from ldo_service.schemas import Message, encode
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import FolderStore, State
from ldo_service.transport.flow_control import (
    InletPosition,
    OutletPosition,
    UnackedMessage,
    credit_key,
)
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import (
    DOUBLES,
    LATEST_NUMBER,
    NUMBERS,
    QUICK,
    Double,
    Number,
    eventually,
    number,
    running,
    send,
)


class Numberer(Actor):
    """An actor that publishes 1, 2, 3, ..., one number for each input while it has credit."""

    name = "numberer"
    inputs = (In(LATEST_NUMBER, Latest(64)),)
    outputs = (Out(NUMBERS, is_nonblocking=True),)

    def __init__(self) -> None:
        super().__init__()
        self.published = 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        if self.has_credit(NUMBERS):
            self.published += 1
            yield number(self.published)

    def snapshot(self) -> State:
        return {"published": self.published}

    def restore(self, state: State) -> None:
        self.published = state["published"]


class Adder(Actor):
    """An actor that publishes two messages for each value. Its state lags behind its inputs."""

    name = "adder"
    lags = True
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)
    failing_value: int | None = None  # The handler raises at this value.

    def __init__(self) -> None:
        super().__init__()
        self.values: list[int] = []
        self._saved: dict[str, list[int]] = {}

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self.values.append(message.value)
        if message.value == self.failing_value:
            raise ValueError("failing value")
        yield Double(stamp_ns=1, value=2 * message.value)
        yield Double(stamp_ns=1, value=2 * message.value + 1)

    def snapshot(self) -> State:
        return self._saved if len(self.values) % 5 else self.checkpoint()

    def checkpoint(self) -> State:
        self._saved = {"values": list(self.values)}
        return self._saved

    def restore(self, state: State) -> None:
        self.values = list(state["values"])


class SavingCollector(Actor):
    name = "collector"
    inputs = (In(DOUBLES, Lossless(3)),)

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Double)
        self.seen.append(message.value)
        yield from ()

    def snapshot(self) -> State:
        return {"seen": list(self.seen)}

    def restore(self, state: State) -> None:
        self.seen = list(state["seen"])


MAKERS = {"numberer": Numberer, "adder": Adder, "collector": SavingCollector}
EXPECTED = {NUMBERS.name: frozenset({"adder"}), DOUBLES.name: frozenset({"collector"})}


class Pipeline:
    """The three actors; each can be killed and restarted at any point of its step."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.transport = folder, MemoryTransport()
        self.tasks: dict[str, asyncio.Task[None]] = {}
        self.stages: dict[str, Stage] = {}

    def start(self, name: str) -> None:
        store = FolderStore(self.folder)
        self.stages[name] = Stage(
            MAKERS[name], self.transport, config=QUICK, store=store, expected=EXPECTED
        )
        self.tasks[name] = asyncio.create_task(self.stages[name].run())

    async def kill(self, name: str) -> None:
        self.tasks[name].cancel()
        await asyncio.gather(self.tasks[name], return_exceptions=True)
        self.stages[name]._worker.join(10)  # A killed process stops writing.
        self.transport.leave(name)

    def is_quiet(self) -> bool:
        """Return whether no message is queued or in progress and all outputs are handled."""
        healths = [stage.health() for stage in self.stages.values()]
        outlets = self.stages["numberer"]._outlets[Number], self.stages["adder"]._outlets[Double]
        unhandled = [past.unhandled for outlet in outlets if (past := outlet.position())]
        waiting = [count.queued for health in healths for count in health.inputs]
        return not any((*unhandled, *waiting, *(health.current_step_s for health in healths)))

    def saved(self, name: str) -> State:
        return RestoredState.of(FolderStore(self.folder).load(name)).own


@pytest.mark.parametrize("seed", range(4))
async def test_each_value_arrives_once_although_actors_are_killed(
    tmp_path: Path, seed: int
) -> None:
    rng, pipeline = Random(seed), Pipeline(tmp_path)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), pipeline.transport)
    for name in MAKERS:
        pipeline.start(name)
    await asyncio.sleep(0)
    for value in range(40):
        await send(feed, number(value))
        if rng.random() < 0.3:
            killed = rng.sample(list(MAKERS), rng.choice([1, 1, 2, 3]))
            for name in killed:
                await pipeline.kill(name)
            for name in killed:
                pipeline.start(name)
            await asyncio.sleep(0)  # Lets the stages start.
        await asyncio.sleep(rng.random() * 0.03)
    await eventually(pipeline.is_quiet)
    for name in MAKERS:
        await pipeline.kill(name)
    published = pipeline.saved("numberer")["published"]
    assert published > 3
    assert pipeline.saved("collector")["seen"] == [*range(2, 2 * published + 2)]


# --- failing disk ---------------------------------------------------------------------------------
class FailingStore(MemoryStore):
    is_full = False
    failing_actor = ""  # Saves of this actor fail although the disk is not full.

    def save(self, actor: str, state: State, unsynced: Iterable[Path] = ()) -> None:
        if self.is_full or self.failing_actor == actor:
            raise OSError(28, "No space left on device")
        super().save(actor, state, unsynced)


async def test_unsaved_step_is_neither_acknowledged_nor_published() -> None:
    transport, store = MemoryTransport(), FailingStore()
    adder = Stage(Adder, transport, config=QUICK, store=store, expected=EXPECTED)
    collector = Stage(SavingCollector, transport, config=QUICK)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(adder, collector):
        await eventually(lambda: numbers.credits() == 4)
        store.is_full = True
        await send(numbers, number(1))
        await eventually(lambda: adder.health().failures == 1)
        await asyncio.sleep(0.05)  # Enough for several heartbeats and their credit messages.
        assert [sent.seq for sent in (numbers.position() or OutletPosition(0, 0)).unhandled] == [0]
        assert collector.health().steps == 0
        store.is_full = False
        await eventually(lambda: collector.health().steps == 2)
        assert adder.health().steps == 1
        assert adder.health().metrics["checkpoints_failed"] >= 1
    assert RestoredState.of(store.load("adder")).inputs[NUMBERS.name].handled == 1


async def test_nonblocking_actor_continues_on_full_disk_and_holds_its_output() -> None:
    transport, store = MemoryTransport(), FailingStore()
    numberer = Stage(Numberer, transport, config=QUICK, store=store, expected=EXPECTED)
    adder = Stage(Adder, transport, config=QUICK)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), transport)
    async with running(numberer, adder):
        await eventually(lambda: numberer._outlets[Number].credits() == 4)
        store.is_full = True
        for value in range(5):
            await send(feed, number(value))
        await eventually(lambda: numberer.health().steps == 5)
        assert adder.health().steps == 0, "the first output is held, and the others have no credit"
        store.is_full = False
        await eventually(lambda: adder.health().steps == 1)  # The retry needs no new message.
        await send(feed, number(7))
        await eventually(lambda: adder.health().steps == 2)
    assert store.load("numberer")["published"] == 2


@pytest.mark.parametrize("kind", ["numberer", "adder"])
async def test_soft_stop_does_not_wait_for_a_failing_disk(kind: str, caplog) -> None:
    """The unsaved step is not part of the state, so the restored actor repeats it."""
    transport, store = MemoryTransport(), FailingStore()
    numberer = Stage(Numberer, transport, config=QUICK, store=store, expected=EXPECTED)
    adder = Stage(Adder, transport, config=QUICK, store=store)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), transport)
    ending = {"numberer": numberer, "adder": adder}[kind]
    async with running(numberer, adder) as tasks:
        await eventually(lambda: numberer._outlets[Number].credits() == 4)
        store.failing_actor = kind
        await send(feed, number(1))
        await eventually(lambda: ending.health().failures == 1)
        ending.drain()
        await eventually(tasks[kind == "adder"].done)
    assert f"{kind}: stopped before its last step was saved" in caplog.text
    past = RestoredState.of(store.load(kind))
    assert past.own.get("published", 0) == 0
    assert past.own.get("values", []) == []


async def test_stage_waiting_for_its_disk_is_not_evicted() -> None:
    transport, store = MemoryTransport(), FailingStore()
    adder = Stage(Adder, transport, config=QUICK, store=store)
    evicted: list[str] = []
    numbers = Outlet(
        Out(NUMBERS), "source", new_epoch(), transport, ("adder",), 0.1, evicted.append
    )
    async with running(adder):
        await eventually(lambda: numbers.credits() == 4)
        store.failing_actor = "adder"
        for value in range(4):
            await send(numbers, number(value))
        await eventually(lambda: adder.health().failures == 1)
        loop = asyncio.get_running_loop()

        def on_grant(_header: bytes, _body: memoryview) -> None:
            """Check for a stall after each credit message: a pause of this process is no stall."""
            loop.call_soon_threadsafe(numbers.evict_stalled, loop.time())

        transport.subscribe(credit_key(NUMBERS.name), on_grant)
        await asyncio.sleep(0.3)  # Three times `evict_after_s`.
        assert numbers.credits() == 0
        store.failing_actor = ""
        await eventually(lambda: adder.health().steps == 4)
    assert evicted == []


async def test_failing_snapshot_is_a_failed_step_not_a_full_disk(caplog) -> None:
    """The message becomes a dead letter at its second failure."""

    class Unsaveable(Adder):
        def snapshot(self) -> State:
            if self.values[-1:] == [2]:
                raise TypeError("no state")
            return super().snapshot()

    transport = MemoryTransport()
    adder = Stage(Unsaveable, transport, config=QUICK)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(adder):
        for value in (1, 2, 3):
            await send(numbers, number(value))
        await eventually(lambda: adder.health().steps == 2)
        assert adder.health().dead_lettered == 1
        assert cast(Adder, adder._actor).values == [1, 3]
    assert "no state" in caplog.text
    assert "Free some disk space" not in caplog.text


# --- write-ahead log ------------------------------------------------------------------------------
def logged_input(value: int) -> LoggedInput:
    return LoggedInput.of(NUMBERS.name, encode(number(value)), FlowStatus())


def test_restored_actor_replays_logged_inputs() -> None:
    past = RestoredState(own={"values": [1, 2]}, taken=(logged_input(3), logged_input(4)))
    actor = restore_actor(Adder(), past, Adder)
    assert actor.values == [1, 2, 3, 4]


def test_logged_input_that_fails_in_replay_leaves_the_state_unchanged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class FailingAdder(Adder):
        failing_value = 3

    past = RestoredState(own={"values": [1, 2]}, taken=(logged_input(3), logged_input(4)))
    assert restore_actor(FailingAdder(), past, FailingAdder).values == [1, 2, 4]
    assert "replaying a logged input of test/number failed" in caplog.text


async def test_write_ahead_log_is_bounded() -> None:
    class NeverSaving(Adder):
        """An actor that never makes a checkpoint on its own."""

        def snapshot(self) -> State:
            return self._saved

    transport, store = MemoryTransport(), MemoryStore()
    adder = Stage(NeverSaving, transport, config=QUICK, store=store)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(adder):
        for value in range(MAX_WAL_ENTRIES + 3):
            await send(numbers, number(value))
        await eventually(lambda: adder.health().steps == MAX_WAL_ENTRIES + 3)
    past = RestoredState.of(store.load("adder"))
    assert past.own["values"] == list(range(MAX_WAL_ENTRIES + 1))
    assert len(past.taken) == 2


def test_stored_state_is_parsed_into_its_parts() -> None:
    sent = tuple(UnackedMessage(seq, b"header", b"body %d" % seq) for seq in (9, 10, 11))
    state = {
        "values": [1],
        "stage.offsets": {"in": {NUMBERS.name: (5, 3)}, "out": {DOUBLES.name: (7, 12, None)}},
        **{f"stage.outbox test.double {one.seq}": one for one in reversed(sent)},
        "stage.wal 4": logged_input(8),
    }
    past = RestoredState.of(state)
    assert past.own == {"values": [1]}
    assert past.inputs == {NUMBERS.name: InletPosition(5, 3)}
    assert past.outputs == {DOUBLES.name: OutletPosition(7, 12, sent)}
    assert past.outputs[DOUBLES.name].handled == 9
    assert past.taken == (logged_input(8),)
    assert past.has_passed
    assert RestoredState.of(None).is_none
