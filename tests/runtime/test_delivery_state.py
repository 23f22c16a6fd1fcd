"""What a stage keeps beside a state: each message takes effect once, whoever is killed."""

import asyncio
from collections.abc import Iterator
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
from ldo_service.storage.state_store import FolderStore, MemoryStore, State
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


class Giver(Actor):
    """Hands on each value, where there is room, with a number of its own."""

    name = "giver"
    inputs = (In(LATEST_NUMBER, Latest(64)),)
    outputs = (Out(NUMBERS, is_nonblocking=True),)

    def __init__(self) -> None:
        super().__init__()
        self.given = 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        if self.has_credit(NUMBERS):
            self.given += 1
            yield number(self.given)

    def snapshot(self) -> State:
        return {"given": self.given}

    def restore(self, state: State) -> None:
        self.given = state["given"]


class Adder(Actor):
    """Two messages for each value: their order, and that both come, matters. Its state lags."""

    name = "adder"
    lags = True
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)
    unlucky: int | None = None  # fails

    def __init__(self) -> None:
        super().__init__()
        self.values: list[int] = []
        self._saved: dict[str, list[int]] = {}

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self.values.append(message.value)
        if message.value == self.unlucky:
            raise ValueError("unlucky")
        yield Double(stamp_ns=1, value=2 * message.value)
        yield Double(stamp_ns=1, value=2 * message.value + 1)

    def snapshot(self) -> State:
        return self._saved if len(self.values) % 5 else self.checkpoint()

    def checkpoint(self) -> State:
        self._saved = {"values": list(self.values)}
        return self._saved

    def restore(self, state: State) -> None:
        self.values = list(state["values"])


class Keeper(Actor):
    name = "keeper"
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


MAKERS = {"giver": Giver, "adder": Adder, "keeper": Keeper}
EXPECTED = {NUMBERS.name: frozenset({"adder"}), DOUBLES.name: frozenset({"keeper"})}


class Company:
    """The three of them; each may be killed and started again, at any point of its step."""

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
        self.stages[name]._worker.join(10)  # a process would not write on
        self.transport.leave(name)

    def is_quiet(self) -> bool:
        """Nothing waits or is under way, and all that was made is handled and saved."""
        healths = [stage.health() for stage in self.stages.values()]
        outlets = self.stages["giver"]._outlets[Number], self.stages["adder"]._outlets[Double]
        unhandled = [past.unhandled for outlet in outlets if (past := outlet.position())]
        waiting = [count.queued for health in healths for count in health.inputs]
        return not any((*unhandled, *waiting, *(health.current_step_s for health in healths)))

    def saved(self, name: str) -> State:
        return RestoredState.of(FolderStore(self.folder).load(name)).own


@pytest.mark.parametrize("seed", range(4))
async def test_whoever_is_killed_and_when_each_value_arrives_once(
    tmp_path: Path, seed: int
) -> None:
    rng, company = Random(seed), Company(tmp_path)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), company.transport)
    for name in MAKERS:
        company.start(name)
    await asyncio.sleep(0)
    for value in range(40):
        await send(feed, number(value))
        if rng.random() < 0.3:
            killed = rng.sample(list(MAKERS), rng.choice([1, 1, 2, 3]))
            for name in killed:
                await company.kill(name)
            for name in killed:
                company.start(name)
            await asyncio.sleep(0)  # they have begun
        await asyncio.sleep(rng.random() * 0.03)
    await eventually(company.is_quiet)
    for name in MAKERS:
        await company.kill(name)
    given = company.saved("giver")["given"]
    assert given > 3
    assert company.saved("keeper")["seen"] == [*range(2, 2 * given + 2)]


# --- a disk that takes nothing --------------------------------------------------------------------
class Moody(MemoryStore):
    is_full = False
    fails = ""  # for this actor alone

    def save(self, actor: str, state: State) -> None:
        if self.is_full or self.fails == actor:
            raise OSError(28, "No space left on device")
        super().save(actor, state)


async def test_a_step_that_is_not_saved_is_neither_acknowledged_nor_told() -> None:
    transport, store = MemoryTransport(), Moody()
    adder = Stage(Adder, transport, config=QUICK, store=store, expected=EXPECTED)
    keeper = Stage(Keeper, transport, config=QUICK)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(adder, keeper):
        await eventually(lambda: numbers.credits() == 4)
        store.is_full = True
        await send(numbers, number(1))
        await eventually(lambda: adder.health().failures == 1)
        await asyncio.sleep(0.05)  # heartbeats, and grants with them
        assert [sent.seq for sent in (numbers.position() or OutletPosition(0, 0)).unhandled] == [0]
        assert keeper.health().steps == 0
        store.is_full = False
        await eventually(lambda: keeper.health().steps == 2)
        assert adder.health().steps == 1
        assert adder.health().metrics["checkpoints_failed"] >= 1
    assert RestoredState.of(store.load("adder")).inputs[NUMBERS.name].handled == 1


async def test_who_never_waits_goes_on_without_a_disk_and_makes_nothing_to_lose() -> None:
    transport, store = MemoryTransport(), Moody()
    giver = Stage(Giver, transport, config=QUICK, store=store, expected=EXPECTED)
    adder = Stage(Adder, transport, config=QUICK)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), transport)
    async with running(giver, adder):
        await eventually(lambda: giver._outlets[Number].credits() == 4)
        store.is_full = True
        for value in range(5):
            await send(feed, number(value))
        await eventually(lambda: giver.health().steps == 5)
        assert adder.health().steps == 0, "the first is held, and for the others there is no room"
        store.is_full = False
        await eventually(lambda: adder.health().steps == 1)  # though no message comes
        await send(feed, number(7))
        await eventually(lambda: adder.health().steps == 2)
    assert store.load("giver")["given"] == 2


@pytest.mark.parametrize("kind", ["giver", "adder"])
async def test_a_soft_stop_does_not_wait_for_a_disk(kind: str, caplog) -> None:
    """And who goes on from there does the step again."""
    transport, store = MemoryTransport(), Moody()
    giver = Stage(Giver, transport, config=QUICK, store=store, expected=EXPECTED)
    adder = Stage(Adder, transport, config=QUICK, store=store)
    feed = Outlet(Out(LATEST_NUMBER), "feed", new_epoch(), transport)
    ending = {"giver": giver, "adder": adder}[kind]
    async with running(giver, adder) as tasks:
        await eventually(lambda: giver._outlets[Number].credits() == 4)
        store.fails = kind
        await send(feed, number(1))
        await eventually(lambda: ending.health().failures == 1)
        ending.drain()
        await eventually(tasks[kind == "adder"].done)
    assert f"{kind}: stopped with one unsaved step" in caplog.text
    past = RestoredState.of(store.load(kind))
    assert past.own.get("given", 0) == 0
    assert past.own.get("values", []) == []


async def test_a_stage_that_waits_for_its_disk_says_so_to_its_producers() -> None:
    transport, store = MemoryTransport(), Moody()
    adder = Stage(Adder, transport, config=QUICK, store=store)
    evicted: list[str] = []
    numbers = Outlet(
        Out(NUMBERS), "source", new_epoch(), transport, ("adder",), 0.1, evicted.append
    )
    async with running(adder):
        await eventually(lambda: numbers.credits() == 4)
        store.fails = "adder"
        for value in range(4):
            await send(numbers, number(value))
        await eventually(lambda: adder.health().failures == 1)
        loop = asyncio.get_running_loop()

        def on_grant(_header: bytes, _body: memoryview) -> None:
            """Check after each grant: a pause of the whole process is no silence of the adder."""
            loop.call_soon_threadsafe(numbers.evict_stalled)

        transport.subscribe(credit_key(NUMBERS.name), on_grant)
        await asyncio.sleep(0.3)  # three times the patience
        assert numbers.credits() == 0
        store.fails = ""
        await eventually(lambda: adder.health().steps == 4)
    assert evicted == []


async def test_a_state_that_cannot_be_made_is_no_full_disk(caplog) -> None:
    """The step fails as any other, and is set aside the second time."""

    class Broken(Adder):
        def snapshot(self) -> State:
            if self.values[-1:] == [2]:
                raise TypeError("no state")
            return super().snapshot()

    transport = MemoryTransport()
    adder = Stage(Broken, transport, config=QUICK)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(adder):
        for value in (1, 2, 3):
            await send(numbers, number(value))
        await eventually(lambda: adder.health().steps == 2)
        assert adder.health().dead_lettered == 1
        assert cast(Adder, adder._actor).values == [1, 3]
    assert "no state" in caplog.text
    assert "Free some disk space" not in caplog.text


# --- what a lagging actor took --------------------------------------------------------------------
def taken(value: int) -> LoggedInput:
    return LoggedInput.of(NUMBERS.name, encode(number(value)), FlowStatus())


def test_a_successor_handles_again_what_the_state_does_not_know() -> None:
    past = RestoredState(own={"values": [1, 2]}, taken=(taken(3), taken(4)))
    actor = restore_actor(Adder(), past, Adder)
    assert actor.values == [1, 2, 3, 4]


def test_what_fails_then_is_left_out_without_a_trace(caplog: pytest.LogCaptureFixture) -> None:
    class Unlucky(Adder):
        unlucky = 3

    past = RestoredState(own={"values": [1, 2]}, taken=(taken(3), taken(4)))
    assert restore_actor(Unlucky(), past, Unlucky).values == [1, 2, 4]
    assert "replaying a logged input of test/number failed" in caplog.text


async def test_what_was_taken_is_bounded() -> None:
    class Slow(Adder):
        """Would never save by itself."""

        def snapshot(self) -> State:
            return self._saved

    transport, store = MemoryTransport(), MemoryStore()
    slow = Stage(Slow, transport, config=QUICK, store=store)
    numbers = Outlet(Out(NUMBERS), "source", new_epoch(), transport, ("adder",))
    async with running(slow):
        for value in range(MAX_WAL_ENTRIES + 3):
            await send(numbers, number(value))
        await eventually(lambda: slow.health().steps == MAX_WAL_ENTRIES + 3)
    past = RestoredState.of(store.load("adder"))
    assert past.own["values"] == list(range(MAX_WAL_ENTRIES + 1))
    assert len(past.taken) == 2


def test_a_state_is_taken_apart_as_it_was_put_together() -> None:
    sent = tuple(UnackedMessage(seq, b"header", b"body %d" % seq) for seq in (9, 10, 11))
    state = {
        "values": [1],
        "stage.offsets": {"in": {NUMBERS.name: (5, 3)}, "out": {DOUBLES.name: (7, 12)}},
        **{f"stage.outbox test.double {one.seq}": one for one in reversed(sent)},
        "stage.wal 4": taken(8),
    }
    past = RestoredState.of(state)
    assert past.own == {"values": [1]}
    assert past.inputs == {NUMBERS.name: InletPosition(5, 3)}
    assert past.outputs == {DOUBLES.name: OutletPosition(7, 12, sent)}
    assert past.outputs[DOUBLES.name].handled == 9
    assert past.taken == (taken(8),)
    assert past.has_passed
    assert RestoredState.of(None).is_none
