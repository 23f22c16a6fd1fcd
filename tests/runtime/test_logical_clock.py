"""Tests of offline runs: the outputs depend only on the inputs and the declared latencies."""

import random
import threading
import time
from collections.abc import Iterator
from typing import ClassVar

import pytest

from ldo_service.errors import LosslessCycle, StageError
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import Message

from .fake_actors import DOUBLES, NUMBERS, PIECES, Double, Doubler, Number, Piece, number


class SlowDoubler(Doubler):
    """An actor that takes a random time for each message."""

    def handle(self, message: Message) -> Iterator[Message]:
        time.sleep(random.random() * 0.004)
        yield from super().handle(message)


class OrderCollector(Actor):
    """An actor that records the messages of two inputs in their order of arrival."""

    name = "collector"
    inputs = (In(NUMBERS, Lossless()), In(DOUBLES, Lossless()))

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def handle(self, message: Message) -> Iterator[Message]:
        time.sleep(random.random() * 0.002)
        assert isinstance(message, Number | Double)
        self.seen.append(f"{type(message).__name__[0]}{message.value}")
        yield from ()


def source(count: int) -> list[Number]:
    return [number(value) for value in range(count)]


def run(
    actors: list[Actor], latency_ticks: dict[str, int], count: int
) -> list[tuple[str, Message]]:
    outputs: list[tuple[str, Message]] = []
    with LogicalClock(
        actors, latency_ticks, lambda actor, message, _step_ms: outputs.append((actor, message))
    ) as clock:
        assert list(clock.run(source(count))) == list(range(count))
        clock.finish()
    return outputs


def test_result_is_independent_of_step_durations() -> None:
    def run_once() -> tuple[list[str], list[tuple[str, Message]]]:
        collector = OrderCollector()
        return collector.seen, run([SlowDoubler(), collector], {"doubler": 2}, 25)

    first = run_once()
    assert all(run_once() == first for _ in range(3))
    assert len(first[0]) == 50


def test_output_becomes_visible_after_the_declared_latency() -> None:
    collector = OrderCollector()
    run([Doubler(), collector], {"doubler": 2}, 5)
    assert collector.seen == ["N0", "N1", "N2", "D0", "N3", "D2", "N4", "D4", "D6", "D8"]


def test_output_without_latency_is_visible_within_its_tick() -> None:
    collector = OrderCollector()
    run([Doubler(), collector], {}, 3)
    assert collector.seen == ["N0", "D0", "N1", "D2", "N2", "D4"]


def test_actors_run_in_parallel() -> None:
    """Each actor waits for the other, so a single thread would never finish."""

    class BarrierActor(Doubler):
        barrier: ClassVar[threading.Barrier] = threading.Barrier(2, timeout=60)

        def handle(self, _message: Message) -> Iterator[Message]:
            self.barrier.wait()
            yield from ()

    class SecondBarrierActor(BarrierActor):
        name = "other"
        outputs = ()

    run([BarrierActor(), SecondBarrierActor()], {"doubler": 1, "other": 1}, 3)


def test_latest_inputs_drop_no_messages() -> None:
    class Newest(OrderCollector):
        inputs = (In(NUMBERS, Latest(1)),)

    newest = Newest()
    run([newest], {"collector": 3}, 10)
    assert len(newest.seen) == 10


class FinalDoubler(Doubler):
    outputs = (Out(DOUBLES, is_final=True),)

    def on_stop(self) -> Iterator[Message]:
        yield Double(stamp_ns=9, value=-1)


class CountPublisher(OrderCollector):
    outputs = (Out(PIECES, is_final=True),)

    def on_stop(self) -> Iterator[Message]:
        yield Piece(stamp_ns=0, version=len(self.seen), part=0, parts=1)


def test_final_messages_come_last_and_producers_first() -> None:
    collector = CountPublisher()
    outputs = run([FinalDoubler(), collector], {"doubler": 4}, 3)
    assert collector.seen[-2:] == ["D4", "D-1"]
    assert outputs[-1] == ("collector", Piece(stamp_ns=0, version=7, part=0, parts=1))


def test_actor_finishes_after_those_whose_final_messages_reach_it() -> None:
    outputs = run([CountPublisher(), FinalDoubler()], {"doubler": 4}, 3)
    assert [name for name, _ in outputs[-2:]] == ["doubler", "collector"]


def test_actors_finish_after_an_empty_source() -> None:
    assert run([FinalDoubler()], {}, 0) == [("doubler", Double(stamp_ns=9, value=-1))]


@pytest.mark.parametrize("latency", [0, 3])
def test_failure_names_the_actor_and_ends_the_threads(latency: int) -> None:
    class FailingDoubler(Doubler):
        def handle(self, message: Message) -> Iterator[Message]:
            assert isinstance(message, Number)
            yield Double(stamp_ns=0, value=10 // (2 - message.value))

    with pytest.raises(
        StageError, match=r"doubler failed at tick \d of the logical clock: ZeroDivisionError"
    ) as caught:
        run([FailingDoubler(), OrderCollector()], {"doubler": latency}, 10)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert not [thread for thread in threading.enumerate() if "doubler" in thread.name]


def test_aborted_run_ends_its_threads() -> None:
    with LogicalClock([Doubler()], {}) as clock:
        assert next(iter(clock.run(source(5)))) == 0
    assert not [thread for thread in threading.enumerate() if "doubler" in thread.name]


def test_second_source_continues_after_the_first() -> None:
    collector = OrderCollector()
    with LogicalClock([Doubler(), collector], {"doubler": 2}) as clock:
        assert list(clock.run(source(2))) == [0, 1]
        assert collector.seen == ["N0", "N1", "D0", "D2"], "no message is in progress"
        clock.finish()
        assert list(clock.run(source(1))) == [2]
    assert collector.seen[4:] == ["N0", "D0"]


def test_step_times_are_recorded_per_actor() -> None:
    with LogicalClock([Doubler(), OrderCollector()], {}) as clock:
        list(clock.run(source(4)))
    assert {name: len(times) for name, times in clock.step_ms().items()} == {
        "doubler": 4,
        "collector": 8,
    }


def test_lossless_cycle_is_rejected_at_construction() -> None:
    class Loop(Doubler):
        inputs = (In(DOUBLES, Lossless()),)

    with pytest.raises(LosslessCycle):
        LogicalClock([Loop()], {})


def test_messages_of_one_batch_share_a_tick() -> None:
    collector = OrderCollector()
    with LogicalClock([Doubler(), collector], {"doubler": 1}) as clock:
        assert list(clock.run([(number(0), number(1)), number(2)])) == [0, 1]
    assert collector.seen == ["N0", "N1", "N2", "D0", "D2", "D4"]
