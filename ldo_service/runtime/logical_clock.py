"""Offline run of the whole actor graph, on a logical clock that ticks once per frame.

A tick delivers one frame. Before the frame, it delivers poses of the odometry prior: all new poses
that are older than the frame, and the first pose that is not older.

Each actor has a configured latency in ticks. With a latency of n, consumers receive the outputs of
a step n ticks after its input, however long the step takes. Actors compute in parallel, each in its
own thread. The clock waits for a step only at the tick in which its outputs are delivered. The
result therefore depends only on the input and the latencies, not on the machine or its load. No
message is dropped.
"""

import heapq
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from ldo_service.errors import StageError
from ldo_service.schemas import Message

from .actor import Actor
from .actor_graph import check_graph, finish_order

Observer = Callable[[str, Message, float], None]  # Actor, output, duration of the step in ms.


@dataclass(frozen=True, slots=True)
class StepOutput:
    """Outputs of one step and its duration."""

    messages: list[Message]
    step_ms: float  # Wall time, ms.


@dataclass(order=True)
class PendingOutput:
    """Outputs of a step that is still running.

    Outputs of one tick are delivered in the order of the actors in the graph. Outputs of one actor
    are delivered in the order in which the steps started.
    """

    tick: int  # Tick at which the outputs are delivered.
    rank: int  # Position of the actor in the graph.
    order: int  # Number of the step, counted over all actors.
    answer: Future[StepOutput] = field(compare=False)


@dataclass
class ActorThread:
    """Actor on a logical clock, with a thread of its own."""

    actor: Actor
    rank: int  # Position of the actor in the graph.
    latency_ticks: int  # Ticks from the input of a step to the delivery of its outputs.
    thread: ThreadPoolExecutor
    # Wall time of each step, ms, except steps that only stored their input.
    step_ms: list[float] = field(default_factory=list)

    def start(self, message: Message) -> Future[StepOutput]:
        """Start to process a message; the step runs in the thread of the actor."""
        return self.thread.submit(self._step, message)

    def finish(self) -> Future[StepOutput]:
        """Start publishing the actor's final messages in the actor's thread."""
        return self.thread.submit(lambda: _timed(self.actor.on_stop()))

    def _step(self, message: Message) -> StepOutput:
        answer = _timed(self.actor.handle(message))
        if answer.messages or not self.actor.outputs:  # Other steps only stored their input.
            self.step_ms.append(answer.step_ms)
        return answer


def _timed(messages: Iterator[Message]) -> StepOutput:
    started_s = time.perf_counter()
    produced = list(messages)
    return StepOutput(produced, 1e3 * (time.perf_counter() - started_s))


class LogicalClock:
    """Runner of an actor graph on a logical clock, for one source or a sequence of sources.

    Example:
        with LogicalClock(actors, latencies) as clock:
            for tick in clock.run(source): ...  # Or clock.tick(item) for each item.
            clock.finish()
    """

    def __init__(
        self,
        actors: Sequence[Actor],
        latency_ticks: Mapping[str, int],
        observe: Observer = lambda _actor, _message, _step_ms: None,
    ) -> None:
        """Create one thread for each actor.

        Args:
            actors: The actors, producers first.
            latency_ticks: Latency of each actor in ticks, by name; 0 where absent.
            observe: Called for each output when it is delivered, with the name of the actor, the
                message and the duration of the step in ms.
        """
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
        self.now = -1  # Tick of the output that is being delivered, for an observer.

    def __enter__(self) -> "LogicalClock":
        return self

    def __exit__(self, *_exception: object) -> None:
        for thread in self._threads:  # Ask each thread to end before waiting for the first one.
            thread.thread.shutdown(wait=False, cancel_futures=True)
        for thread in self._threads:
            thread.thread.shutdown()

    def run(self, source: Iterable[Message | tuple[Message, ...]]) -> Iterator[int]:
        """Deliver each item of the source in a tick of its own, and yield the number of the tick.

        After the last item, wait for all running steps.

        Args:
            source: Messages; the messages of a tuple are delivered in one tick.

        Raises:
            StageError: A handler raised; the error names the actor.
        """
        for item in source:
            yield self.tick(item)
        self._settle_all()

    def tick(self, item: Message | tuple[Message, ...]) -> int:
        """Deliver an item in a new tick, and wait for the outputs that are due by then.

        Args:
            item: A message, or a tuple of messages that are delivered in the same tick.

        Returns:
            Number of the tick.

        Raises:
            StageError: A handler raised; the error names the actor.
        """
        self._tick += 1
        for message in item if isinstance(item, tuple) else (item,):
            self._deliver(message, self._tick)
        self._settle(self._tick)
        return self._tick

    def finish(self) -> None:
        """Wait for all running steps, and deliver the final messages of each actor.

        The order is that of `finish_order`. `run` and `tick` may be called again afterwards.
        """
        self._settle_all()
        threads = {thread.actor.name: thread for thread in self._threads}
        for actor in finish_order([type(thread.actor) for thread in self._threads]):
            thread = threads[actor.name]
            self._expect(thread, self._tick, thread.finish())
            self._settle_all()

    def step_ms(self) -> dict[str, list[float]]:
        """Return the wall times of the steps so far, ms, by actor.

        Steps that only stored their input are excluded.
        """
        return {thread.actor.name: thread.step_ms for thread in self._threads}

    def _deliver(self, message: Message, tick: int) -> None:
        for thread in self._takers.get(type(message), ()):
            self._expect(thread, tick + thread.latency_ticks, thread.start(message))

    def _expect(self, thread: ActorThread, tick: int, answer: Future[StepOutput]) -> None:
        self._started += 1
        heapq.heappush(self._due, PendingOutput(tick, thread.rank, self._started, answer))

    def _settle(self, tick: int) -> None:
        """Wait for the outputs of all ticks up to this one and deliver them."""
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
            f"{actor} failed at tick {due.tick} of the logical clock: {type(error).__name__}: "
            f"{error}. `ldo --debug` prints the traceback; please report it."
        ) from error
