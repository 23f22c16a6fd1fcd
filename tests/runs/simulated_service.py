"""Simulation of the live service in logical time, with actors that take given times for a step.

All actors run in this process, one step after another. A step takes the given logical time, and its
outputs arrive at its end. Queues, credits, backlogs and idle steps follow the policies of the
ports. Equal arguments give equal results, on any machine and under any load.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import count

from ldo_service.runtime import Actor, In, Latest
from ldo_service.runtime.actor import Backlog, FlowStatus, Lossless
from ldo_service.runtime.step import produce
from ldo_service.schemas import LabelRequest, Message
from ldo_service.schemas.topics import Topic

# Logical time of a step by actor, seconds: roughly those of images of 320x240 on two cores.
STEP_S = {"tracker": 0.05, "mapper": 0.1, "detector": 0.1, "vlm_labeller": 0.1,
          "loop_closer": 0.05, "optimizer": 0.02}  # fmt: skip

StepTime = Callable[[str, Message, float], float]  # Actor, input and start of the step, seconds.
Observer = Callable[[str, Message, float], None]  # Actor, output and end of the step, seconds.


@dataclass
class SimulatedStage:
    """Actor with the queue of its inputs."""

    actor: Actor
    queue: deque[tuple[In, Message]] = field(default_factory=deque)
    is_busy: bool = False
    quiet_since_s: float = 0.0

    def accept(self, port: In, message: Message) -> None:
        if isinstance(port.policy, Latest):
            waiting = [one for one in self.queue if one[0].topic is port.topic]
            if len(waiting) >= port.policy.depth:
                self.queue.remove(waiting[0])
        self.queue.append((port, message))

    def queued(self, topic: Topic) -> int:
        return sum(port.topic is topic for port, _ in self.queue)


class SimulatedService:
    """Service with all its actors in logical time."""

    def __init__(
        self,
        actors: Iterable[Actor],
        step_s: StepTime = lambda actor, _message, _now_s: STEP_S.get(actor, 0.0),
        observe: Observer = lambda _actor, _message, _now_s: None,
    ) -> None:
        """Create the service.

        Args:
            actors: The actors, producers first.
            step_s: Logical time of a step, seconds.
            observe: Called with each output when it arrives.
        """
        self.stages = {actor.name: SimulatedStage(actor) for actor in actors}
        self._step_s, self._observe = step_s, observe
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self.now_s = 0.0
        self.idle_steps = 0
        # Messages in transit or in a step, by consumer and topic.
        self._unhandled: dict[tuple[str, Topic], int] = {}

    def actor(self, name: str) -> Actor:
        return self.stages[name].actor

    def run(self, source: Iterable[Message], interval_s: float, *, still_s: float = 60.0) -> None:
        """Send messages at an interval, and then wait until no actor has work.

        Args:
            source: Messages from outside, such as frames.
            interval_s: Logical time between two messages, seconds.
            still_s: Minimum logical time after the last message, seconds.
        """
        for number, message in enumerate(source):
            due_s = number * interval_s
            self._run_until(due_s)
            self.now_s = due_s
            self._publish(message)
        end_s = self.now_s + still_s
        self._at(end_s, lambda: None)
        while self._events:
            self._step_event()

    def stop(self) -> None:
        """Publish the final messages of all actors."""
        for stage in self.stages.values():
            for message in stage.actor.on_stop():
                self._observe(stage.actor.name, message, self.now_s)

    # --- events -----------------------------------------------------------------------------------
    def _at(self, at_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (at_s, next(self._order), action))

    def _run_until(self, end_s: float) -> None:
        while self._events and self._events[0][0] <= end_s:
            self._step_event()

    def _step_event(self) -> None:
        self.now_s, _, action = heapq.heappop(self._events)
        action()

    def _publish(self, message: Message) -> None:
        for stage in self.stages.values():
            for port in stage.actor.inputs:
                if port.topic.message is type(message):
                    key = stage.actor.name, port.topic
                    self._unhandled[key] = self._unhandled.get(key, 0) + 1
                    stage.accept(port, message)
                    self._start(stage)

    # --- steps ------------------------------------------------------------------------------------
    def _start(self, stage: SimulatedStage) -> None:
        """Start the next step of an actor that is not busy."""
        if stage.is_busy or not stage.queue:
            return
        first = next((one for one in stage.queue if one[0].has_priority), stage.queue[0])
        stage.queue.remove(first)
        port, message = first
        actor = stage.actor
        self._set_situation(stage)
        took_s = self._step_s(actor.name, message, self.now_s)
        outputs = [one.message for one in produce(actor, actor.handle(message))]
        self._finish_later(stage, outputs, took_s, port.topic)

    def _finish_later(
        self, stage: SimulatedStage, outputs: list[Message], took_s: float, topic: Topic | None
    ) -> None:
        stage.is_busy = True

        def finish() -> None:
            stage.is_busy, stage.quiet_since_s = False, self.now_s
            if topic is not None:
                self._unhandled[stage.actor.name, topic] -= 1
            for message in outputs:
                self._observe(stage.actor.name, message, self.now_s)
                self._publish(message)
            self._start(stage)
            self._at(self.now_s + stage.actor.idle_after_s, lambda: self._idle(stage))

        self._at(self.now_s + took_s, finish)

    def _idle(self, stage: SimulatedStage) -> None:
        """Do an idle step if no message came for long enough and the actor has idle work."""
        actor = stage.actor
        is_quiet = self.now_s >= stage.quiet_since_s + actor.idle_after_s - 1e-9
        if stage.is_busy or stage.queue or not is_quiet:
            return
        self._set_situation(stage)
        if actor.has_idle_work():
            self.idle_steps += 1
            outputs = [one.message for one in produce(actor, actor.on_idle())]
            self._finish_later(stage, outputs, STEP_S.get(actor.name, 0.0), None)

    def _set_situation(self, stage: SimulatedStage) -> None:
        actor = stage.actor
        credits = {
            out.topic: min(self._credits(out.topic), default=1 << 30)
            for out in actor.outputs
            if out.is_nonblocking
        }
        lossless = [port.topic for port in actor.inputs if isinstance(port.policy, Lossless)]
        actor.situation = FlowStatus(credits, {topic: stage.queued(topic) for topic in lossless})

    def _credits(self, topic: Topic) -> Iterator[int]:
        """Yield the credit that each consumer grants for a topic."""
        for stage in self.stages.values():
            for port in stage.actor.inputs:
                limits = not isinstance(port.policy, Backlog) or topic.message is LabelRequest
                if port.topic is topic and isinstance(port.policy, Lossless) and limits:
                    yield port.policy.window - self._unhandled.get((stage.actor.name, topic), 0)
