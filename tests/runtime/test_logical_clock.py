"""The graph over a file: what comes out depends on the input and the latencies alone."""

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


class Sleepy(Doubler):
    """Takes a random time for each message."""

    def handle(self, message: Message) -> Iterator[Message]:
        time.sleep(random.random() * 0.004)
        yield from super().handle(message)


class Mixer(Actor):
    """Mixes what it sees in the order in which it sees it."""

    name = "mixer"
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
    made: list[tuple[str, Message]] = []
    with LogicalClock(
        actors, latency_ticks, lambda actor, message, _step_ms: made.append((actor, message))
    ) as clock:
        assert list(clock.run(source(count))) == list(range(count))
        clock.finish()
    return made


def test_the_result_does_not_depend_on_how_long_actors_take() -> None:
    def once() -> tuple[list[str], list[tuple[str, Message]]]:
        mixer = Mixer()
        return mixer.seen, run([Sleepy(), mixer], {"doubler": 2}, 25)

    first = once()
    assert all(once() == first for _ in range(3))
    assert len(first[0]) == 50


def test_an_answer_becomes_visible_after_the_declared_latency() -> None:
    mixer = Mixer()
    run([Doubler(), mixer], {"doubler": 2}, 5)
    assert mixer.seen == ["N0", "N1", "N2", "D0", "N3", "D2", "N4", "D4", "D6", "D8"]


def test_without_latency_an_answer_is_visible_within_its_tick() -> None:
    mixer = Mixer()
    run([Doubler(), mixer], {}, 3)
    assert mixer.seen == ["N0", "D0", "N1", "D2", "N2", "D4"]


def test_actors_compute_side_by_side() -> None:
    """Each waits for the other, which one thread alone could never do."""

    class Partner(Doubler):
        both: ClassVar[threading.Barrier] = threading.Barrier(2, timeout=60)

        def handle(self, _message: Message) -> Iterator[Message]:
            self.both.wait()
            yield from ()

    class Other(Partner):
        name = "other"
        outputs = ()

    run([Partner(), Other()], {"doubler": 1, "other": 1}, 3)


def test_nothing_is_dropped_not_even_by_latest() -> None:
    class Newest(Mixer):
        inputs = (In(NUMBERS, Latest(1)),)

    newest = Newest()
    run([newest], {"mixer": 3}, 10)
    assert len(newest.seen) == 10


class Talker(Doubler):
    def on_stop(self) -> Iterator[Message]:
        yield Double(stamp_ns=9, value=-1)


class Counter(Mixer):
    outputs = (Out(PIECES),)

    def on_stop(self) -> Iterator[Message]:
        yield Piece(stamp_ns=0, version=len(self.seen), part=0, parts=1)


def test_last_words_come_producers_first_after_everything_else() -> None:
    counter = Counter()
    made = run([Talker(), counter], {"doubler": 4}, 3)
    assert counter.seen[-2:] == ["D4", "D-1"]
    assert made[-1] == ("mixer", Piece(stamp_ns=0, version=7, part=0, parts=1))


def test_who_tells_what_came_of_the_others_last_words_comes_last() -> None:
    class LastTalker(Talker):
        finishes_last = True

    made = run([LastTalker(), Counter()], {"doubler": 4}, 3)
    assert [name for name, _ in made[-2:]] == ["mixer", "doubler"]


def test_an_empty_source_still_lets_actors_finish() -> None:
    assert run([Talker()], {}, 0) == [("doubler", Double(stamp_ns=9, value=-1))]


@pytest.mark.parametrize("latency", [0, 3])
def test_a_failure_names_the_actor_and_ends_the_threads(latency: int) -> None:
    class Fragile(Doubler):
        def handle(self, message: Message) -> Iterator[Message]:
            assert isinstance(message, Number)
            yield Double(stamp_ns=0, value=10 // (2 - message.value))

    with pytest.raises(StageError, match=r"doubler failed at tick \d: ZeroDivisionError") as caught:
        run([Fragile(), Mixer()], {"doubler": latency}, 10)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert not [thread for thread in threading.enumerate() if "doubler" in thread.name]


def test_a_run_that_is_broken_off_ends_its_threads() -> None:
    with LogicalClock([Doubler()], {}) as clock:
        assert next(iter(clock.run(source(5)))) == 0
    assert not [thread for thread in threading.enumerate() if "doubler" in thread.name]


def test_a_second_source_goes_on_where_the_first_ended() -> None:
    mixer = Mixer()
    with LogicalClock([Doubler(), mixer], {"doubler": 2}) as clock:
        assert list(clock.run(source(2))) == [0, 1]
        assert mixer.seen == ["N0", "N1", "D0", "D2"], "nothing is left under way"
        clock.finish()
        assert list(clock.run(source(1))) == [2]
    assert mixer.seen[4:] == ["N0", "D0"]


def test_step_times_are_kept_by_actor() -> None:
    with LogicalClock([Doubler(), Mixer()], {}) as clock:
        list(clock.run(source(4)))
    assert {name: len(times) for name, times in clock.step_ms().items()} == {
        "doubler": 4,
        "mixer": 8,
    }


def test_a_cycle_is_refused_before_anything_starts() -> None:
    class Loop(Doubler):
        inputs = (In(DOUBLES, Lossless()),)

    with pytest.raises(LosslessCycle):
        LogicalClock([Loop()], {})


def test_messages_that_come_together_share_a_tick() -> None:
    mixer = Mixer()
    with LogicalClock([Doubler(), mixer], {"doubler": 1}) as clock:
        assert list(clock.run([(number(0), number(1)), number(2)])) == [0, 1]
    assert mixer.seen == ["N0", "N1", "N2", "D0", "D2", "D4"]
