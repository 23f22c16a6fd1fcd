"""What a stage keeps beside its actor's state, and in one write with it.

    stage.offsets      where it stands on each lossless topic: number of the next message
    stage.outbox T N   message N of topic T, which some expected consumer has not handled
    stage.wal N    what an actor took whose state lags behind, since that state

So a successor is where the last finished step was: what it took is not taken again, what it made is
sent once more until it was handled, and nothing else was sent.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ldo_service.schemas import decode
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State
from ldo_service.transport.flow_control import InletPosition, OutletPosition, UnackedMessage

from .actor import Actor, FlowStatus
from .step import produce

log = logging.getLogger(__name__)

OFFSETS, OUTBOX, WAL = "stage.offsets", "stage.outbox", "stage.wal"
# messages that a lagging actor's successor handles again, some seconds of work
MAX_WAL_ENTRIES = 64


class LoggedInput(NamedTuple):
    """A message that was handled, and the situation it was handled in; counts by topic."""

    topic: str
    body: bytes
    credits: Mapping[str, int]
    backlog: Mapping[str, int]

    @classmethod
    def of(cls, topic: str, body: bytes | memoryview, situation: FlowStatus) -> "LoggedInput":
        credits = {topic.name: count for topic, count in situation.credits.items()}
        backlog = {topic.name: count for topic, count in situation.backlog.items()}
        return cls(topic, bytes(body), credits, backlog)

    def situation(self, actor: Actor) -> FlowStatus:
        return FlowStatus(
            credits=counts_by_topic(self.credits, (out.topic for out in actor.outputs)),
            backlog=counts_by_topic(self.backlog, (port.topic for port in actor.inputs)),
        )


@dataclass(frozen=True)
class RestoredState:
    """A saved state, taken apart."""

    own: State = field(default_factory=dict)  # the actor's
    inputs: Mapping[str, InletPosition] = field(default_factory=dict)
    outputs: Mapping[str, OutletPosition] = field(default_factory=dict)
    taken: tuple[LoggedInput, ...] = ()
    is_none: bool = False  # nothing was saved

    @classmethod
    def of(cls, state: State | None) -> "RestoredState":
        if not state:
            return cls(is_none=True)
        links = state.get(OFFSETS, {"in": {}, "out": {}})  # none: no lossless neighbours
        return cls(
            own={part: value for part, value in state.items() if not part.startswith("stage.")},
            inputs={topic: InletPosition(*past) for topic, past in links["in"].items()},
            outputs={
                topic: OutletPosition(epoch, seq, tuple(_sent(state, topic)))
                for topic, (epoch, seq) in links["out"].items()
            },
            taken=tuple(LoggedInput(*state[part]) for part in _numbered(state, WAL)),
        )

    @property
    def of_actor(self) -> State:
        """All that decides what it does next."""
        return {**self.own, **{f"{WAL} {n}": one for n, one in enumerate(self.taken)}}

    @property
    def has_passed(self) -> bool:
        """Whether anything was taken or made on a lossless topic."""
        handled = any(past.handled for past in self.inputs.values())
        return handled or any(past.seq for past in self.outputs.values())


class DeliveryState:
    """Makes the parts; those that did not change are the same objects as before."""

    def __init__(self) -> None:
        self._links: dict[str, Any] = {}
        self._own: State = {}
        self._taken: dict[str, LoggedInput] = {}
        self._number = 0

    @property
    def is_long(self) -> bool:
        return len(self._taken) >= MAX_WAL_ENTRIES

    def own(self, own: State, taken: LoggedInput | None, whole: bool) -> dict[str, Any]:
        """The actor's state; with what it took since, if that is not `whole`, nor another one than
        before."""
        is_new = own.keys() != self._own.keys() or any(own[p] is not self._own[p] for p in own)
        if is_new or whole:
            self._own, self._taken = own, {}
        elif taken is not None:
            self._taken[f"{WAL} {self._number}"] = taken
            self._number += 1
        return {**own, **self._taken}

    def links(
        self, inputs: Mapping[str, InletPosition], outputs: Mapping[str, OutletPosition]
    ) -> dict[str, Any]:
        """Nothing for an actor without lossless neighbours."""
        if not inputs and not outputs:
            return {}
        places = {
            "in": dict(inputs),
            "out": {topic: (past.epoch, past.seq) for topic, past in outputs.items()},
        }
        if places != self._links:
            self._links = places
        sent = {
            f"{_sent_part(topic)} {sent.seq}": sent
            for topic, past in outputs.items()
            for sent in past.unhandled
        }
        return {OFFSETS: self._links, **sent}


def restore_actor(actor: Actor, past: RestoredState, make: Callable[[], Actor]) -> Actor:
    """An actor as its predecessor was after its last saved step, from one that was just made.

    What it took since its state it handles again, for the state alone: what it made then was kept.
    A message that fails now is left out, and all the others go to another one made.
    """
    taken = list(past.taken)
    while True:
        if past.own:
            actor.restore(past.own)
        failed = _handled_again(actor, taken)
        if failed is None:
            return actor
        del taken[failed]
        actor = make()


def _handled_again(actor: Actor, taken: Iterable[LoggedInput]) -> int | None:
    """Which of them fails first."""
    kinds = {port.topic.name: port.topic.message for port in actor.inputs}
    for number, one in enumerate(taken):
        kind = kinds[one.topic]
        assert kind is not None
        actor.situation = one.situation(actor)
        try:
            produce(actor, actor.handle(decode(one.body, kind)))
        except Exception:
            log.exception("%s: %s fails now and is left out", actor.name, one.topic)
            return number
    return None


def counts_by_topic(counts: Mapping[str, int], topics: Iterable[Topic]) -> dict[Topic, int]:
    return {topic: counts[topic.name] for topic in topics if topic.name in counts}


def _sent_part(topic: str) -> str:
    return f"{OUTBOX} {topic.replace('/', '.')}"


def _sent(state: State, topic: str) -> Iterator[UnackedMessage]:
    for part in _numbered(state, _sent_part(topic)):
        yield UnackedMessage(*state[part])


def _numbered(state: State, kind: str) -> list[str]:
    """Parts `<kind> <number>`, by number."""
    parts = [part for part in state if part.rpartition(" ")[0] == kind]
    return sorted(parts, key=lambda part: int(part.rpartition(" ")[2]))
