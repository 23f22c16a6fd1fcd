"""One actor at work: failures, stalls, soft stops, health."""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from ldo_service.errors import ConfigError, RestartsExhausted, StageStalled
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage, SupervisionConfig, new_epoch
from ldo_service.schemas import Health, Message, decode
from ldo_service.storage.state_store import FolderStore, MemoryStore, State
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import (
    DOUBLES,
    LATEST_NUMBER,
    NUMBERS,
    PIECES,
    QUICK,
    Double,
    DoubleCollector,
    Doubler,
    Number,
    Piece,
    collector,
    eventually,
    number,
    running,
    send,
)


def source(transport: MemoryTransport, *expected: str) -> Outlet:
    return Outlet(Out(NUMBERS), "source", new_epoch(), transport, expected)


class Adder(Actor):
    """Sums up; keeps the sum, and fails where `trouble` says so."""

    name = "adder"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)

    def __init__(self, trouble: Callable[[int], None] = lambda _value: None) -> None:
        super().__init__()
        self._trouble, self._sum = trouble, 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self._sum += message.value
        self._trouble(message.value)
        yield Double(stamp_ns=message.stamp_ns, value=self._sum)

    def on_stop(self) -> Iterator[Message]:
        yield Double(stamp_ns=0, value=-self._sum)

    def snapshot(self) -> State:
        return {"sum": self._sum}

    def on_saved(self) -> None:
        if isinstance(self._trouble, Trouble):
            self._trouble.saved.append(self._sum)

    def restore(self, state: State) -> None:
        self._sum = state["sum"]

    def metrics(self) -> dict[str, float]:
        return {"sum": float(self._sum)}


class Trouble:
    """Fails on a value, so many times."""

    def __init__(self, value: int, times: int, error: BaseException | None = None) -> None:
        self._value, self._left, self._error = value, times, error or RuntimeError("trouble")
        self.saved: list[int] = []  # sums, as the adder was told

    def __call__(self, value: int) -> None:
        if value == self._value and self._left > 0:
            self._left -= 1
            raise self._error


async def run_adder(trouble: Trouble, values: list[int], **options: Any) -> tuple[list[int], Stage]:
    """What an adder that meets trouble says, and its stage."""
    transport, sums = MemoryTransport(), []
    adder = Stage(lambda: Adder(trouble), transport, config=QUICK, **options)
    numbers = source(transport, "adder")
    async with running(adder, Stage(lambda: DoubleCollector(sums), transport, config=QUICK)):
        for value in values:
            await send(numbers, number(value))
        await numbers.flush()
        await eventually(lambda: adder.health().steps + adder.health().dead_lettered == len(values))
        await eventually(lambda: len(sums) == adder.health().steps)
    return sums, adder


async def test_messages_travel_from_actor_to_actor() -> None:
    transport, seen = MemoryTransport(), []
    numbers = source(transport, "doubler")
    expected = {DOUBLES.name: frozenset({"double_collector"})}
    stages = (
        Stage(Doubler, transport, config=QUICK, expected=expected),
        Stage(lambda: DoubleCollector(seen), transport, config=QUICK),
    )
    async with running(*stages):
        for value in range(30):
            await send(numbers, number(value))
        await eventually(lambda: len(seen) == 30)
    assert seen == [2 * value for value in range(30)]


async def test_after_a_failure_a_successor_goes_on_from_the_last_state() -> None:
    sums, stage = await run_adder(Trouble(value=3, times=1), [1, 2, 3, 4])
    assert sums == [1, 3, 6, 10]  # the half step before the failure left no trace
    health = stage.health()
    assert (health.steps, health.failures, health.restarts, health.dead_lettered) == (4, 1, 1, 0)


async def test_a_message_that_fails_twice_is_set_aside_and_the_rest_is_handled() -> None:
    sums, stage = await run_adder(Trouble(value=3, times=99), [1, 2, 3, 4])
    assert sums == [1, 3, 7]
    health = stage.health()
    assert (health.steps, health.failures, health.restarts, health.dead_lettered) == (3, 2, 2, 1)


@pytest.mark.parametrize("error", [StopIteration(), SystemExit(1), KeyboardInterrupt()])
async def test_whatever_a_handler_raises_is_a_failed_step(error: BaseException) -> None:
    sums, stage = await run_adder(Trouble(value=2, times=1, error=error), [1, 2])
    assert sums == [1, 3]
    assert stage.health().failures == 1


async def test_an_actor_is_told_when_its_state_is_saved() -> None:
    peace = Trouble(value=-1, times=0)
    await run_adder(peace, [1, 2, 3])
    assert peace.saved[:4] == [0, 1, 3, 6]


async def test_the_next_process_goes_on_from_the_folder(tmp_path: Path) -> None:
    peace = Trouble(value=-1, times=0)
    await run_adder(peace, [1, 2, 3], store=FolderStore(tmp_path))
    sums, _ = await run_adder(peace, [4], store=FolderStore(tmp_path))
    assert sums == [10]


async def test_a_message_that_is_none_of_the_outputs_is_a_failure_of_the_actor() -> None:
    class Stranger(Doubler):
        outputs = ()

    transport = MemoryTransport()
    stage = Stage(Stranger, transport, config=QUICK)
    numbers = source(transport, "doubler")
    async with running(stage):
        await send(numbers, number(1))
        await eventually(lambda: stage.health().dead_lettered == 1)


async def test_too_many_failures_exhaust_the_restarts() -> None:
    transport = MemoryTransport()
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=3)
    stage = Stage(lambda: Adder(_always_fail), transport, config=config)
    numbers = source(transport, "adder")
    running_stage = asyncio.create_task(stage.run())
    for value in range(3):
        await send(numbers, number(value))
    with pytest.raises(RestartsExhausted, match="adder failed 4 times"):
        await running_stage


def _always_fail(_value: int) -> None:
    raise RuntimeError("always")


async def test_a_state_that_cannot_be_restored_exhausts_the_restarts() -> None:
    class Picky(Adder):
        def restore(self, state: State) -> None:
            raise KeyError(f"what is {state}?")

    transport, store = MemoryTransport(), MemoryStore()
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=2)
    stage = Stage(lambda: Picky(Trouble(2, 1)), transport, config=config, store=store)
    numbers = source(transport, "adder")
    running_stage = asyncio.create_task(stage.run())
    await asyncio.sleep(0)
    await send(numbers, number(1))
    await send(numbers, number(2))
    with pytest.raises(RestartsExhausted):
        await running_stage


async def test_a_handler_that_does_not_return_is_a_stall() -> None:
    transport, stuck = MemoryTransport(), Event()
    config = SupervisionConfig(heartbeat_s=0.01, stall_after_s=0.05)
    stage = collector(transport, [], lambda _value: stuck.wait(60) and None, config=config)
    numbers = source(transport, "collector")
    running_stage = asyncio.create_task(stage.run())
    await send(numbers, number(0))
    with pytest.raises(StageStalled, match="collector has been busy"):
        await running_stage
    stuck.set()


async def test_a_soft_stop_handles_what_has_arrived_and_says_the_last_words() -> None:
    transport, sums, go = MemoryTransport(), [], Event()

    def wait(_value: int) -> None:
        go.wait(60)

    adder = Stage(lambda: Adder(wait), transport, config=QUICK)
    numbers = source(transport, "adder")
    async with running(adder, Stage(lambda: DoubleCollector(sums), transport, config=QUICK)) as run:
        for value in (1, 2, 3):
            await send(numbers, number(value))
        adder.drain()
        assert adder.health().state == "draining"
        go.set()
        await run[0]
        await eventually(lambda: len(sums) == 4)
    assert sums == [1, 3, 6, -6]


async def test_a_soft_stop_before_the_start_ends_at_once() -> None:
    stage = Stage(Doubler, MemoryTransport(), config=QUICK)
    stage.drain()
    await asyncio.wait_for(stage.run(), 60)


async def test_last_words_that_fail_do_not_hinder_the_stop() -> None:
    class Speechless(Doubler):
        def on_stop(self) -> Iterator[Message]:
            raise RuntimeError("no words")

    stage = Stage(Speechless, MemoryTransport(), config=QUICK)
    stage.drain()
    await asyncio.wait_for(stage.run(), 60)
    assert stage.health().failures == 1


async def test_heartbeats_carry_the_counters() -> None:
    transport, beats = MemoryTransport(), []
    transport.subscribe("health/adder", lambda _header, body: beats.append(decode(body, Health)))
    stage = Stage(Adder, transport, config=QUICK)
    numbers = source(transport, "adder")
    async with running(stage):
        await eventually(lambda: beats)
        assert beats[0].state == "ready"
        for value in (1, 2, 3):
            await send(numbers, number(value))
        await eventually(lambda: beats[-1].steps == 3 and beats[-1].state == "ready")
        last = beats[-1]
    assert (last.actor, last.stamp_ns, last.metrics) == ("adder", 3, {"sum": 6.0})
    assert (last.inputs[0].topic, last.inputs[0].delivered) == (NUMBERS.name, 3)
    assert (last.outputs[0].topic, last.outputs[0].sent) == (DOUBLES.name, 3)
    assert last.rss_mb > 1
    assert last.current_step_s == 0
    assert last.step_ms_p95 >= last.step_ms_p50 >= 0


async def test_a_busy_stage_says_so_in_its_heartbeat() -> None:
    transport, beats, stuck = MemoryTransport(), [], Event()
    transport.subscribe(
        "health/collector", lambda _header, body: beats.append(decode(body, Health))
    )
    stage = collector(transport, [], lambda _value: stuck.wait(60) and None)
    numbers = source(transport, "collector")
    async with running(stage):
        await send(numbers, number(0))
        await eventually(
            lambda: beats and beats[-1].state == "busy" and beats[-1].current_step_s > 0
        )
        stuck.set()
        await eventually(lambda: beats[-1].state == "ready" and beats[-1].steps == 1)


class Sometimes(Actor):
    """Makes a number of what it sees, where there is room."""

    name = "sometimes"
    inputs = (In(LATEST_NUMBER, Latest(64)),)
    outputs = (Out(NUMBERS, is_nonblocking=True),)

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        if self.has_credit(NUMBERS):
            yield message


async def test_an_output_that_never_waits_is_made_only_where_there_is_room() -> None:
    transport, seen, stuck = MemoryTransport(), [], Event()
    expected = {NUMBERS.name: frozenset({"collector"})}
    stage = Stage(Sometimes, transport, config=QUICK, expected=expected)
    feed = Outlet(Out(LATEST_NUMBER), "feed", 1, transport)
    async with running(stage):
        await send(feed, number(0))  # nobody there yet: no room
        await eventually(lambda: stage.health().steps == 1)
        async with running(collector(transport, seen, lambda _value: stuck.wait(60) and None)):
            await eventually(lambda: stage._outlets[Number].credits() == 4)
            for value in range(1, 21):
                await send(feed, number(value))
            await eventually(lambda: stage.health().steps == 21)  # it never waited
            assert stage.health().outputs[0].backpressure_waits == 0
            assert stage.health().outputs[0].sent == 4
            stuck.set()
            await eventually(lambda: seen == [1, 2, 3, 4])


async def test_an_actor_that_ignores_the_room_fails_and_nothing_piles_up() -> None:
    class Pushy(Sometimes):
        def handle(self, message: Message) -> Iterator[Message]:
            yield message

    transport = MemoryTransport()
    expected = {NUMBERS.name: frozenset({"collector"})}
    stage = Stage(Pushy, transport, config=QUICK, expected=expected)
    feed = Outlet(Out(LATEST_NUMBER), "feed", 1, transport)
    async with running(stage):
        await send(feed, number(0))
        await eventually(lambda: stage.health().dead_lettered == 1)
        assert stage.health().outputs[0].sent == 0


async def test_a_state_topic_answers_with_its_last_value_and_all_its_parts() -> None:
    transport = MemoryTransport()
    pieces = Outlet(Out(PIECES), "me", 1, transport)

    def answered() -> list[tuple[int, int]]:
        answers = [decode(body, Piece) for _header, body in transport.query(PIECES.name)]
        return [(piece.version, piece.part) for piece in answers]

    assert answered() == []
    for part in range(3):
        await send(pieces, Piece(stamp_ns=1, version=1, part=part, parts=3))
    assert answered() == [(1, 0), (1, 1), (1, 2)]
    await send(pieces, Piece(stamp_ns=2, version=2, part=0, parts=2))
    assert answered() == [(1, 0), (1, 1), (1, 2)]  # half a value is none
    await send(pieces, Piece(stamp_ns=2, version=2, part=1, parts=2))
    assert answered() == [(2, 0), (2, 1)]


async def test_a_state_topic_of_one_part_answers_with_the_newest() -> None:
    transport = MemoryTransport()
    latest = Outlet(Out(LATEST_NUMBER), "me", 1, transport)
    for value in range(3):
        await send(latest, number(value))
    ((_header, body),) = transport.query(LATEST_NUMBER.name)
    assert decode(body, Number).value == 2


@pytest.mark.parametrize(
    "options",
    [
        {"max_restarts": -1},
        {"heartbeat_s": 0},
        {"stall_after_s": 0},
        {"evict_after_s": 0},
        {"max_message_mb": 0},
    ],
)
def test_an_impossible_configuration_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        SupervisionConfig(**options)


class Queued(Actor):
    """Doubles how many numbers wait behind the one it handles."""

    name = "queued"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)

    def __init__(self, stuck: Event) -> None:
        super().__init__()
        self._stuck, self.seen = stuck, []

    def handle(self, message: Message) -> Iterator[Message]:
        self.seen.append(self.situation.backlog[NUMBERS])
        self._stuck.wait(60)
        yield Double(stamp_ns=message.stamp_ns, value=0)


async def test_an_actor_sees_how_many_messages_wait() -> None:
    transport, stuck = MemoryTransport(), Event()
    actor = Queued(stuck)
    stage = Stage(lambda: actor, transport, config=QUICK)
    feed = Outlet(Out(NUMBERS), "feed", 1, transport, (stage.name,))
    async with running(stage):
        await send(feed, number(0))
        await eventually(lambda: actor.seen)
        for value in (1, 2, 3):
            await send(feed, number(value))
        stuck.set()
        await eventually(lambda: stage.health().steps == 4)
    assert actor.seen == [0, 2, 1, 0]
