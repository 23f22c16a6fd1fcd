"""The whole graph over a file, on a clock that ticks once per frame.

What comes along with a frame, such as poses of another odometry, comes in the same tick, before it.

What an actor makes of a message becomes visible a declared number of ticks after it took the
message, however long it really took. Actors compute side by side, each in its own thread; a thread
is waited for when the clock reaches the tick at which its answer is due. So the result depends on
the input and the latencies alone, not on the machine or its load, and nothing is dropped.
"""

import heapq
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from ldo_service.errors import StageError
from ldo_service.schemas import Message

from .actor import Actor
from .actor_graph import check_graph

Observer = Callable[[str, Message, float], None]  # actor, what it made, milliseconds of the step


@dataclass(frozen=True, slots=True)
class StepOutput:
    messages: list[Message]
    step_ms: float  # wall time


@dataclass(order=True)
class PendingOutput:
    """An answer under way; equal ticks are settled in the order of the graph, then of starting."""

    tick: int
    rank: int
    order: int
    answer: Future[StepOutput] = field(compare=False)


@dataclass
class ActorThread:
    actor: Actor
    rank: int
    latency_ticks: int
    thread: ThreadPoolExecutor
    step_ms: list[float] = field(
        default_factory=list
    )  # of each step, but those that took note only

    def start(self, message: Message) -> Future[StepOutput]:
        return self.thread.submit(self._step, message)

    def finish(self) -> Future[StepOutput]:
        return self.thread.submit(lambda: _timed(self.actor.on_stop()))

    def _step(self, message: Message) -> StepOutput:
        answer = _timed(self.actor.handle(message))
        if answer.messages or not self.actor.outputs:  # notes would hide what a frame costs
            self.step_ms.append(answer.step_ms)
        return answer


def _timed(messages: Iterator[Message]) -> StepOutput:
    started_s = time.perf_counter()
    produced = list(messages)
    return StepOutput(produced, 1e3 * (time.perf_counter() - started_s))


class LogicalClock:
    """Feeds a graph of actors from a source, or one after the other; see the module.

    with LogicalClock(actors, latencies) as clock:
        for tick in clock.run(source): ...
        clock.finish()
    """

    def __init__(
        self,
        actors: Sequence[Actor],
        latency_ticks: Mapping[str, int],
        observe: Observer = lambda _actor, _message, _step_ms: None,
    ) -> None:
        check_graph(type(actor) for actor in actors)
        self._threads = [
            ActorThread(
                actor, rank, latency_ticks.get(actor.name, 0), ThreadPoolExecutor(1, actor.name)
            )
            for rank, actor in enumerate(actors)
        ]
        self._takers: dict[type[Message], list[ActorThread]] = {}
        for thread in self._threads:
            for port in thread.actor.inputs:
                self._takers.setdefault(port.topic.message, []).append(thread)
        self._observe = observe
        self._due: list[PendingOutput] = []
        self._started = 0
        self._tick = -1
        self.now = -1  # tick of what is being passed on, for an observer

    def __enter__(self) -> "LogicalClock":
        return self

    def __exit__(self, *_exception: object) -> None:
        for thread in self._threads:
            thread.thread.shutdown(cancel_futures=True)

    def run(self, source: Iterable[Message | tuple[Message, ...]]) -> Iterator[int]:
        """Yield the tick after each item of the source; then everything under way is settled.

        The messages of a tuple share a tick.
        Raises StageError, naming the actor, when a handler raises.
        """
        for item in source:
            self._tick += 1
            for message in item if isinstance(item, tuple) else (item,):
                self._deliver(message, self._tick)
            self._settle(self._tick)
            yield self._tick
        self._settle_all()

    def finish(self) -> None:
        """Let each actor say its last words, producers first, and those last that tell what came of
        the others'. A run may still follow."""
        for thread in sorted(self._threads, key=lambda thread: thread.actor.finishes_last):
            self._expect(thread, self._tick, thread.finish())
            self._settle_all()

    def step_ms(self) -> dict[str, list[float]]:
        """Wall time of every step so far but those that took note only, by actor."""
        return {thread.actor.name: thread.step_ms for thread in self._threads}

    def _deliver(self, message: Message, tick: int) -> None:
        for thread in self._takers.get(type(message), ()):
            self._expect(thread, tick + thread.latency_ticks, thread.start(message))

    def _expect(self, thread: ActorThread, tick: int, answer: Future[StepOutput]) -> None:
        self._started += 1
        heapq.heappush(self._due, PendingOutput(tick, thread.rank, self._started, answer))

    def _settle(self, tick: int) -> None:
        """Wait for every answer that is due by now and pass it on."""
        while self._due and self._due[0].tick <= tick:
            due = heapq.heappop(self._due)
            thread = self._threads[due.rank]
            answer = _answer(due, thread.actor.name)
            self.now = due.tick
            for message in answer.messages:
                self._observe(thread.actor.name, message, answer.step_ms)
                self._deliver(message, due.tick)

    def _settle_all(self) -> None:
        while self._due:
            self._settle(self._due[0].tick)


def _answer(due: PendingOutput, actor: str) -> StepOutput:
    try:
        return due.answer.result()
    except Exception as error:
        raise StageError(
            f"{actor} failed at tick {due.tick}: {type(error).__name__}: {error}. "
            "Run with --debug to see where."
        ) from error
