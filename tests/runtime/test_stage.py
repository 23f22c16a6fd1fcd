"""Tests of a stage: failures, stalls, soft stops and health."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import pytest

from ldo_service.errors import ConfigError, DamagedStateError, RestartsExhausted, StageStalled
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage, SupervisionConfig, new_epoch
from ldo_service.runtime.stage_metrics import StageMetrics
from ldo_service.runtime.supervision_policy import RunningClock
from ldo_service.schemas import Health, Message, decode
from ldo_service.service.diagnostics import ActorStatus, diagnose, find_stall
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import FolderStore, State
from ldo_service.transport.interface import MemoryTransport
from tests.schemas.examples import EXAMPLES

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
    """An actor that publishes the sum so far; `inject` raises at chosen values."""

    name = "adder"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)

    def __init__(self, inject: Callable[[int], None] = lambda _value: None) -> None:
        super().__init__()
        self._inject, self._sum = inject, 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self._sum += message.value
        self._inject(message.value)
        yield Double(stamp_ns=message.stamp_ns, value=self._sum)

    def on_stop(self) -> Iterator[Message]:
        yield Double(stamp_ns=0, value=-self._sum)

    def snapshot(self) -> State:
        return {"sum": self._sum}

    def on_saved(self) -> None:
        if isinstance(self._inject, InjectedFailure):
            self._inject.saved.append(self._sum)

    def restore(self, state: State) -> None:
        self._sum = state["sum"]

    def metrics(self) -> dict[str, float]:
        return {"sum": float(self._sum)}


class InjectedFailure:
    """An error that is raised at one value a number of times."""

    def __init__(self, value: int, times: int, error: BaseException | None = None) -> None:
        self._value, self._left, self._error = value, times, error or RuntimeError("injected")
        self.saved: list[int] = []  # The sum at each call of `on_saved`.

    def __call__(self, value: int) -> None:
        if value == self._value and self._left > 0:
            self._left -= 1
            raise self._error


async def run_adder(
    failure: InjectedFailure, values: list[int], **options: Any
) -> tuple[list[int], Stage]:
    """Run an adder with an injected failure and return its published sums and its stage."""
    transport, sums = MemoryTransport(), []
    adder = Stage(lambda: Adder(failure), transport, config=QUICK, **options)
    numbers = source(transport, "adder")
    async with running(adder, Stage(lambda: DoubleCollector(sums), transport, config=QUICK)):
        for value in values:
            await send(numbers, number(value))
        await numbers.flush()
        await eventually(lambda: adder.health().steps + adder.health().dead_lettered == len(values))
        await eventually(lambda: len(sums) == adder.health().steps)
    return sums, adder


async def test_messages_pass_from_actor_to_actor() -> None:
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


async def test_failed_actor_is_restored_from_its_last_state() -> None:
    sums, stage = await run_adder(InjectedFailure(value=3, times=1), [1, 2, 3, 4])
    assert sums == [1, 3, 6, 10]  # The failed step has no effect.
    health = stage.health()
    assert (health.steps, health.failures, health.restarts, health.dead_lettered) == (4, 1, 1, 0)


async def test_message_that_fails_twice_is_dead_lettered_and_the_rest_handled() -> None:
    sums, stage = await run_adder(InjectedFailure(value=3, times=99), [1, 2, 3, 4])
    assert sums == [1, 3, 7]
    health = stage.health()
    assert (health.steps, health.failures, health.restarts, health.dead_lettered) == (3, 2, 2, 1)


@pytest.mark.parametrize("error", [StopIteration(), SystemExit(1), KeyboardInterrupt()])
async def test_any_exception_of_a_handler_is_a_failed_step(error: BaseException) -> None:
    sums, stage = await run_adder(InjectedFailure(value=2, times=1, error=error), [1, 2])
    assert sums == [1, 3]
    assert stage.health().failures == 1


async def test_on_saved_is_called_after_each_save() -> None:
    no_failure = InjectedFailure(value=-1, times=0)
    await run_adder(no_failure, [1, 2, 3])
    assert no_failure.saved[:4] == [0, 1, 3, 6]


@pytest.mark.parametrize("method", ["on_saved", "metrics"])
async def test_error_after_the_save_does_not_repeat_the_step(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, method: str
) -> None:
    errors = [RuntimeError("after the save")]
    own = getattr(Adder, method)

    def fail_once(adder: Adder) -> object:
        if adder._sum == 3 and errors:
            raise errors.pop()
        return own(adder)

    monkeypatch.setattr(Adder, method, fail_once)
    no_failure = InjectedFailure(value=-1, times=0)
    sums, stage = await run_adder(no_failure, [1, 2, 3], store=FolderStore(tmp_path))
    assert errors == []
    assert sums == [1, 3, 6], "each message counts once"
    assert (stage.health().failures, stage.health().restarts) == (1, 0)


async def test_actor_does_not_start_empty_if_its_state_is_damaged_while_it_runs(
    tmp_path: Path,
) -> None:
    def damage(value: int) -> None:
        if value == 3:
            (path,) = (tmp_path / "adder").glob("sum.*")
            path.write_bytes(b"\xc1")
            raise RuntimeError("injected")

    transport = MemoryTransport()
    adder = Stage(lambda: Adder(damage), transport, config=QUICK, store=FolderStore(tmp_path))
    numbers = source(transport, "adder")
    async with asyncio.TaskGroup() as group:
        running_adder = group.create_task(expect_damaged_state(adder))
        for value in (1, 2, 3):
            await send(numbers, number(value))
        await running_adder
    numbers.close()
    with pytest.raises(DamagedStateError):
        FolderStore(tmp_path).load("adder")


async def expect_damaged_state(stage: Stage) -> None:
    with pytest.raises(DamagedStateError, match=r"the state of adder .* falls back to an older"):
        await stage.run()


async def test_next_process_continues_from_the_stored_state(tmp_path: Path) -> None:
    no_failure = InjectedFailure(value=-1, times=0)
    await run_adder(no_failure, [1, 2, 3], store=FolderStore(tmp_path))
    sums, _ = await run_adder(no_failure, [4], store=FolderStore(tmp_path))
    assert sums == [10]


async def test_undeclared_output_is_a_failed_step() -> None:
    class UndeclaredOutput(Doubler):
        outputs = ()

    transport = MemoryTransport()
    stage = Stage(UndeclaredOutput, transport, config=QUICK)
    numbers = source(transport, "doubler")
    async with running(stage):
        await send(numbers, number(1))
        await eventually(lambda: stage.health().dead_lettered == 1)


async def test_actor_that_fails_on_every_message_is_failing_until_one_is_handled() -> None:
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001)
    transport = MemoryTransport()
    stage = Stage(lambda: Adder(_fail_below(3)), transport, config=config)
    numbers = source(transport, "adder")
    async with running(stage):
        for value, dead_letters in enumerate((1, 2, 3)):
            assert not stage.health().failing
            await send(numbers, number(value))
            await eventually(lambda n=dead_letters: stage.health().dead_lettered == n)
        assert stage.health().failing
        problems = [str(problem) for problem in diagnose(ActorStatus("a", True, stage.health(), 1))]
        assert any("fails on every message" in problem for problem in problems)
        await send(numbers, number(3))
        await eventually(lambda: stage.health().steps == 1)
        assert not stage.health().failing


async def test_messages_that_always_fail_do_not_end_the_stage() -> None:
    transport, failing = MemoryTransport(), range(20)
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=1)
    stage = Stage(lambda: Adder(_fail_below(20)), transport, config=config)
    numbers = source(transport, "adder")
    async with running(stage):
        for value in (*failing, 20):
            await send(numbers, number(value))
        await eventually(lambda: stage.health().steps == 1)
    assert stage.health().dead_lettered == len(failing)


async def test_failures_whose_repetition_succeeds_exhaust_the_restarts() -> None:
    transport = MemoryTransport()
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=2)
    fail = _fail_every_other_time()
    stage = Stage(lambda: Adder(fail), transport, config=config)
    numbers = source(transport, "adder")
    running_stage = asyncio.create_task(stage.run())
    for value in range(3):
        await send(numbers, number(value))
    with pytest.raises(RestartsExhausted, match="adder failed 3 times"):
        await asyncio.wait_for(running_stage, 15)


def _fail_below(limit: int) -> Callable[[int], None]:
    def fail(value: int) -> None:
        if value < limit:
            raise RuntimeError("always")

    return fail


def _fail_every_other_time() -> Callable[[int], None]:
    tries = count()

    def fail(_value: int) -> None:
        if next(tries) % 2 == 0:
            raise RuntimeError("once")

    return fail


async def test_failing_heartbeat_is_counted_and_the_stage_continues() -> None:
    transport, seen = MemoryTransport(), []
    stage = collector(transport, seen)
    numbers = source(transport, "collector")
    async with running(stage):
        stage._metrics.facts = {"broken": "not a number"}  # type: ignore[dict-item]
        await eventually(lambda: stage._metrics.failures > 0)
        stage._metrics.facts = {"not_finite": float("nan"), "good": 1.0}
        await send(numbers, number(7))
        await eventually(lambda: seen == [7])
    assert stage._metrics.failures > 0


async def test_time_without_running_does_not_count_as_a_hanging_step() -> None:
    now_s = 0.0
    metrics = StageMetrics(clock=RunningClock(lambda: now_s))
    metrics.clock.tick(0.5)
    with metrics.step():
        now_s = 0.5
        metrics.clock.tick(0.5)
        now_s = 100.0  # The process was suspended.
        assert metrics.clock.tick(0.5) == pytest.approx(99.0)
        assert metrics.busy_s == pytest.approx(1.0)
        for _ in range(30):  # It runs again, and the step hangs.
            now_s += 1.0
            metrics.clock.tick(0.5)
        assert metrics.busy_s == pytest.approx(31.0)


@pytest.mark.parametrize("fails", [False, True])
def test_long_step_of_a_back_end_is_no_stall_while_its_state_is_saved(
    monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    now_s = 0.0
    monkeypatch.setattr("ldo_service.runtime.stage_metrics.monotonic_s", lambda: now_s)
    metrics = StageMetrics(state="ready", finished_at_s=0.0)
    inputs = (msgspec.structs.replace(EXAMPLES["health"].inputs[0], queued=3),)

    def stall() -> object:
        fields = {"actor": "optimizer", "epoch": 1, "paused": False, "outputs": ()}
        return find_stall(metrics.health(inputs=inputs, **fields))

    with suppress(ValueError), metrics.step():
        now_s = 60.0
        if fails:
            raise ValueError
    now_s = 61.0  # The state is being saved, so the step is not recorded yet.
    assert stall() is None
    now_s = 70.0
    assert "took none of 3 queued messages for 10 s" in str(stall())


async def test_time_without_running_does_not_evict_a_consumer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    transport, release, beats = MemoryTransport(), Event(), []
    config = SupervisionConfig(heartbeat_s=0.02, evict_after_s=500)
    source = Stage(Doubler, transport, config=config)

    class Hanging(DoubleCollector):
        def handle(self, message: Message) -> Iterator[Message]:  # noqa: ARG002
            release.wait(60)
            yield from ()

    consumer = Stage(lambda: Hanging([]), transport, config=config)
    loop, skipped_s = asyncio.get_running_loop(), 0.0
    real_time = loop.time
    monkeypatch.setattr(loop, "time", lambda: real_time() + skipped_s)
    source._metrics.clock = RunningClock(loop.time)
    transport.subscribe("health/doubler", lambda _header, body: beats.append(bytes(body)))
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, ["doubler"])
    async with running(source, consumer):
        for value in range(2):
            await send(numbers, number(value))
        await eventually(lambda: source.health().outputs[0].sent == 2)
        before = len(beats)
        await eventually(lambda: len(beats) > before + 2)  # The window is known to be full.
        skipped_s = 1000.0  # The process was frozen.
        before = len(beats)
        await eventually(lambda: len(beats) > before + 5)
        assert source.health().outputs[0].evicted_consumers == 0
        release.set()


async def test_unrestorable_state_exhausts_the_restarts() -> None:
    class Unrestorable(Adder):
        def restore(self, state: State) -> None:
            raise KeyError(f"cannot restore {state}")

    transport, store = MemoryTransport(), MemoryStore()
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=2)
    stage = Stage(
        lambda: Unrestorable(InjectedFailure(2, 1)), transport, config=config, store=store
    )
    numbers = source(transport, "adder")
    running_stage = asyncio.create_task(stage.run())
    await asyncio.sleep(0)
    await send(numbers, number(1))
    await send(numbers, number(2))
    with pytest.raises(RestartsExhausted):
        await running_stage


async def test_handler_that_does_not_return_raises_stage_stalled() -> None:
    transport, release = MemoryTransport(), Event()
    config = SupervisionConfig(heartbeat_s=0.01, stall_after_s=0.05)
    stage = collector(transport, [], lambda _value: release.wait(60) and None, config=config)
    numbers = source(transport, "collector")
    running_stage = asyncio.create_task(stage.run())
    await send(numbers, number(0))
    with pytest.raises(StageStalled, match="collector has been busy"):
        await running_stage
    release.set()


async def test_soft_stop_handles_queued_messages_and_publishes_final_ones() -> None:
    transport, sums, release = MemoryTransport(), [], Event()

    def wait(_value: int) -> None:
        release.wait(60)

    adder = Stage(lambda: Adder(wait), transport, config=QUICK)
    numbers = source(transport, "adder")
    async with running(adder, Stage(lambda: DoubleCollector(sums), transport, config=QUICK)) as run:
        for value in (1, 2, 3):
            await send(numbers, number(value))
        adder.drain()
        assert adder.health().state == "draining"
        release.set()
        await run[0]
        await eventually(lambda: len(sums) == 4)
    assert sums == [1, 3, 6, -6]


async def test_soft_stop_before_the_start_ends_at_once() -> None:
    stage = Stage(Doubler, MemoryTransport(), config=QUICK)
    stage.drain()
    await asyncio.wait_for(stage.run(), 60)


async def test_failing_on_stop_does_not_prevent_the_stop() -> None:
    class FailingOnStop(Doubler):
        def on_stop(self) -> Iterator[Message]:
            raise RuntimeError("failing on_stop")

    stage = Stage(FailingOnStop, MemoryTransport(), config=QUICK)
    stage.drain()
    await asyncio.wait_for(stage.run(), 60)
    assert stage.health().failures == 1


async def test_heartbeats_contain_the_counters() -> None:
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
    assert (last.actor, last.stamp_ns, last.metrics["sum"]) == ("adder", 3, 6.0)
    assert (last.inputs[0].topic, last.inputs[0].delivered) == (NUMBERS.name, 3)
    assert (last.outputs[0].topic, last.outputs[0].sent) == (DOUBLES.name, 3)
    assert last.rss_mb > 1
    assert last.current_step_s == 0
    assert last.step_ms_p95 >= last.step_ms_p50 >= 0


async def test_heartbeat_reports_a_busy_stage() -> None:
    transport, beats, release = MemoryTransport(), [], Event()
    transport.subscribe(
        "health/collector", lambda _header, body: beats.append(decode(body, Health))
    )
    stage = collector(transport, [], lambda _value: release.wait(60) and None)
    numbers = source(transport, "collector")
    async with running(stage):
        await send(numbers, number(0))
        await eventually(
            lambda: beats and beats[-1].state == "busy" and beats[-1].current_step_s > 0
        )
        release.set()
        await eventually(lambda: beats[-1].state == "ready" and beats[-1].steps == 1)


class NonblockingForwarder(Actor):
    """An actor that forwards numbers while it has credit."""

    name = "forwarder"
    inputs = (In(LATEST_NUMBER, Latest(64)),)
    outputs = (Out(NUMBERS, is_nonblocking=True),)

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        if self.has_credit(NUMBERS):
            yield message


async def test_nonblocking_output_is_published_only_with_credit() -> None:
    transport, seen, release = MemoryTransport(), [], Event()
    expected = {NUMBERS.name: frozenset({"collector"})}
    stage = Stage(NonblockingForwarder, transport, config=QUICK, expected=expected)
    feed = Outlet(Out(LATEST_NUMBER), "feed", 1, transport)
    async with running(stage):
        await send(feed, number(0))  # A stage without consumer has no credit.
        await eventually(lambda: stage.health().steps == 1)
        async with running(collector(transport, seen, lambda _value: release.wait(60) and None)):
            await eventually(lambda: stage._outlets[Number].credits() == 4)
            for value in range(1, 21):
                await send(feed, number(value))
            # The stage never waited for credit.
            await eventually(lambda: stage.health().steps == 21)
            assert stage.health().outputs[0].backpressure_waits == 0
            assert stage.health().outputs[0].sent == 4
            release.set()
            await eventually(lambda: seen == [1, 2, 3, 4])


async def test_publishing_without_credit_is_a_failed_step() -> None:
    class CreditIgnoringForwarder(NonblockingForwarder):
        def handle(self, message: Message) -> Iterator[Message]:
            yield message

    transport = MemoryTransport()
    expected = {NUMBERS.name: frozenset({"collector"})}
    stage = Stage(CreditIgnoringForwarder, transport, config=QUICK, expected=expected)
    feed = Outlet(Out(LATEST_NUMBER), "feed", 1, transport)
    async with running(stage):
        await send(feed, number(0))
        await eventually(lambda: stage.health().dead_lettered == 1)
        assert stage.health().outputs[0].sent == 0


async def test_state_topic_query_returns_all_parts_of_the_last_value() -> None:
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
    assert answered() == [(1, 0), (1, 1), (1, 2)]  # An incomplete value is not returned.
    await send(pieces, Piece(stamp_ns=2, version=2, part=1, parts=2))
    assert answered() == [(2, 0), (2, 1)]


async def test_state_topic_query_returns_the_newest_value() -> None:
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
def test_invalid_configuration_is_rejected(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        SupervisionConfig(**options)


class BacklogRecorder(Actor):
    """An actor that records how many numbers are queued behind the one it handles."""

    name = "recorder"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)

    def __init__(self, release: Event) -> None:
        super().__init__()
        self._release, self.seen = release, []

    def handle(self, message: Message) -> Iterator[Message]:
        self.seen.append(self.situation.backlog[NUMBERS])
        self._release.wait(60)
        yield Double(stamp_ns=message.stamp_ns, value=0)


async def test_actor_receives_the_number_of_queued_messages() -> None:
    transport, release = MemoryTransport(), Event()
    actor = BacklogRecorder(release)
    stage = Stage(lambda: actor, transport, config=QUICK)
    feed = Outlet(Out(NUMBERS), "feed", 1, transport, (stage.name,))
    async with running(stage):
        await send(feed, number(0))
        await eventually(lambda: actor.seen)
        for value in (1, 2, 3):
            await send(feed, number(value))
        release.set()
        await eventually(lambda: stage.health().steps == 4)
    assert actor.seen == [0, 2, 1, 0]
