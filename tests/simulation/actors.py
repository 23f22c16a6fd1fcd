"""Actors without images, on the ports of the real ones, that check what they receive.

Each message on a topic has a number, and a digest of itself and all earlier messages of the topic.
A consumer therefore notices a lost message, a repeated one, and one of another run.
"""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import msgspec

from ldo_service.actors.topology import GRAPH as REAL_GRAPH
from ldo_service.actors.topology import ActorSpec
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State

CHECKPOINT_KEYFRAMES = 4  # Keyframes between two whole states of the mapper, which lags.
IDLE_STEPS = 2  # Steps of idle work of the mapper after each keyframe.


class Note(Message, frozen=True, kw_only=True):
    """Message of a topic.

    Attributes:
        number: Number of earlier messages of the topic in this run.
        before: Digest of the earlier messages; 0 if there are none.
        digest: Digest of this message and the earlier ones.
    """

    number: int
    before: int
    digest: int

    @property
    def keyframe(self) -> int:
        """Number of the keyframe, for `MessageRecorder`."""
        return self.number


def _topic(real: Topic) -> Topic:
    """Return a topic of the same name with a message type of its own."""
    name = "".join(word.capitalize() for word in real.name.split("/"))
    message = msgspec.defstruct(name, [], bases=(Note,), frozen=True, kw_only=True, tag=name)
    return replace(real, message=message, key=None)


_OUTSIDE = [p.topic for box in REAL_GRAPH for p in box.inputs]
TOPICS = {
    topic.name: _topic(topic)
    for topic in [*_OUTSIDE, *(out.topic for box in REAL_GRAPH for out in box.outputs)]
}
CAMERA = TOPICS["camera/rgbd"]

# Outputs by actor and topic of the input that causes them. All other inputs are only counted.
CAUSES: dict[str, dict[str, tuple[str, ...]]] = {
    "frame_source": {"camera/rgbd": ("frame/rgbd",)},
    "tracker": {"frame/rgbd": ("pose/tracked", "keyframe/new", "keyframe/measurements")},
    "detector": {"keyframe/new": ("detection/boxes",)},
    "vlm_labeller": {"label/request": ("label/result",)},
    "mapper": {
        "keyframe/new": (
            *("map/delta", "object/observation", "keyframe/refinement", "label/request"),
        ),
    },
    "loop_closer": {"keyframe/new": ("loop/closure",)},
    "optimizer": {"keyframe/measurements": ("graph/correction",)},
}
ON_RESTORED = {"mapper": "map/snapshot", "optimizer": "graph/correction"}
ON_STOP = {"mapper": "map/snapshot", "loop_closer": "loop/candidate"}
# Topics of which an actor sends a message for every n-th input only.
EVERY = {"loop/closure": 2}


class Position(NamedTuple):
    """Messages of a topic so far: their number, and the digest of all of them."""

    number: int = 0
    digest: int = 0


def note(topic: str, stamp_ns: int, past: Position, digest: int) -> Message:
    """Return a message of a topic, after the earlier ones."""
    kind: Any = TOPICS[topic].message
    return kind(stamp_ns=stamp_ns, number=past.number, before=past.digest, digest=digest)


@dataclass
class Observer:
    """Receiver of what the actors notice.

    Attributes:
        violation: Called with the description of a violated invariant.
        fail_after_save: Called with the name of an actor after each save; it may raise.
    """

    violation: Callable[[str], None]
    fail_after_save: Callable[[str], None]


class SimulatedActor(Actor):
    """Actor that counts its inputs and sends the messages that `CAUSES` lists."""

    def __init__(self, observer: Observer) -> None:
        super().__init__()
        self._observer = observer
        self.made: dict[str, Position] = {}
        self.taken: dict[str, Position] = {}
        # Stamp of the last message of each input, ns.
        self.stamps_ns: dict[str, int] = {}
        self._steps = self._idle_steps = 0
        self._by_message = {port.topic.message: port for port in self.inputs}
        self._saved: State = {}

    # --- steps ----------------------------------------------------------------------------------
    def handle(self, message: Any) -> Iterator[Message]:
        """Check the message, and yield what it causes."""
        port = self._by_message[type(message)]
        topic, nonce = port.topic.name, message.digest
        if isinstance(port.policy, Lossless):
            self._check(topic, message)
        self.taken = {**self.taken, topic: Position(message.number + 1, message.digest)}
        self.stamps_ns = {**self.stamps_ns, topic: message.stamp_ns}
        caused = CAUSES[self.name].get(topic, ())
        self._steps += bool(caused)
        if topic == "keyframe/new" and self.name == "mapper":
            self._idle_steps = IDLE_STEPS
        if caused and not self.has_credit(TOPICS["keyframe/new"]):
            caused = ("pose/tracked",)
        for name in caused:
            is_due = self._steps % EVERY.get(name, 1) == 0
            if is_due and (name != "label/request" or self.has_credit(TOPICS[name])):
                yield self._make(name, message.stamp_ns, nonce)

    def _check(self, topic: str, message: Note) -> None:
        past = self.taken.get(topic, Position())
        if message.number != past.number:
            what = "lost" if message.number > past.number else "repeated"
            self._observer.violation(
                f"{self.name}: message {message.number} of {topic} came where {past.number} was "
                f"expected: messages were {what}, or states of two runs are mixed"
            )
        elif message.before != past.digest:
            self._observer.violation(
                f"{self.name}: message {message.number} of {topic} follows other messages than "
                "this actor has handled: states of two runs are mixed"
            )

    def _make(self, topic: str, stamp_ns: int, nonce: int) -> Message:
        past = self.made.get(topic, Position())
        digest = zlib.crc32(b"%d %d %d" % (past.digest, past.number, nonce))
        self.made = {**self.made, topic: Position(past.number + 1, digest)}
        return note(topic, stamp_ns, past, digest)

    def _publish(self, topic: str | None) -> Iterator[Message]:
        if topic is not None:
            yield self._make(topic, max(self.stamps_ns.values(), default=0), 0)

    def on_restored(self) -> Iterator[Message]:
        """Yield the last values again, as mapper and optimizer do."""
        yield from self._publish(ON_RESTORED.get(self.name))

    def on_stop(self) -> Iterator[Message]:
        """Yield the final messages."""
        yield from self._publish(ON_STOP.get(self.name))

    def has_idle_work(self) -> bool:
        """Return whether idle work is left."""
        return self._idle_steps > 0

    def on_idle(self) -> Iterator[Message]:
        """Do a step of idle work."""
        self._idle_steps -= 1
        yield from self._publish("map/delta")

    # --- state ----------------------------------------------------------------------------------
    def snapshot(self) -> State:
        """Return the state; an actor that lags returns that of an earlier keyframe."""
        keyframes = self.taken.get("keyframe/new", Position()).number
        if self.lags and keyframes < self._saved.get("keyframes", -10) + CHECKPOINT_KEYFRAMES:
            return self._saved
        return self.checkpoint()

    def checkpoint(self) -> State:
        """Return the whole state."""
        self._saved = {
            "keyframes": self.taken.get("keyframe/new", Position()).number,
            "made": self.made,
            "taken": self.taken,
            "rest": (self.stamps_ns, self._steps, self._idle_steps),
        }
        return self._saved

    def restore(self, state: State) -> None:
        """Continue from a saved state."""
        self.made = {topic: Position(*past) for topic, past in state["made"].items()}
        self.taken = {topic: Position(*past) for topic, past in state["taken"].items()}
        self.stamps_ns, self._steps, self._idle_steps = state["rest"]
        self._saved = dict(state)

    def metrics(self) -> dict[str, float]:
        """Return a metric; the stage asks for it after each save."""
        self._observer.fail_after_save(self.name)
        return {"steps": float(self._steps)}


def _actor_type(box: ActorSpec) -> type[SimulatedActor]:
    members = {
        "name": box.name,
        "inputs": tuple(replace(port, topic=TOPICS[port.topic.name]) for port in box.inputs),
        "outputs": tuple(replace(port, topic=TOPICS[port.topic.name]) for port in box.outputs),
        "is_backend": box.is_backend,
        "lags": box.name == "mapper",
        "is_prompt": box.name in ("frame_source", "tracker"),
    }
    return type(f"Simulated{box.name.title()}", (SimulatedActor,), members)


# Types of all actors, producers first, with the ports of `ldo_service.actors.topology.GRAPH`.
GRAPH: tuple[type[SimulatedActor], ...] = tuple(_actor_type(box) for box in REAL_GRAPH)
NAMES = tuple(actor.name for actor in GRAPH)


def links() -> Iterator[tuple[type[SimulatedActor], Out, type[SimulatedActor], In]]:
    """Yield producer, output, consumer and input of each lossless link."""
    for producer in GRAPH:
        for out in producer.outputs:
            for consumer in GRAPH:
                for port in consumer.inputs:
                    if port.topic is out.topic and isinstance(port.policy, Lossless):
                        yield producer, out, consumer, port
