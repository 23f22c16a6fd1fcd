"""Delivery state of a stage: offsets, unhandled outputs and logged inputs.

The stage saves these parts in one write with the actor's state:

- `stage.offsets`: Offset of the next message on each lossless topic.
- `stage.outbox T N`: Message N of topic T, which a required consumer has not handled.
- `stage.wal N`: Entry N of the write-ahead log, only for an actor with `Actor.lags`. Such an actor
  saves the state of an earlier step. The log has the inputs that the actor has handled since then.

A restored stage therefore continues after the last saved step. It does not take the input of that
step again. It sends the outputs of that step again until all required consumers have handled them.
Outputs of an unsaved step were never sent to required consumers.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ldo_service.schemas import Message, decode
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State
from ldo_service.transport.flow_control import InletPosition, OutletPosition, UnackedMessage

from .actor import Actor, FlowStatus
from .inlet import Delivery
from .step import produce

log = logging.getLogger(__name__)

OFFSETS, OUTBOX, WAL = "stage.offsets", "stage.outbox", "stage.wal"
# Maximum number of messages that a restored actor with `lags` handles again: a few seconds of work.
MAX_WAL_ENTRIES = 64


class LoggedInput(NamedTuple):
    """Entry of the write-ahead log: a handled message and the flow status of its step.

    The credits and backlogs of the flow status are counts by topic name.
    """

    topic: str  # Name of the topic; empty for idle work, which has no message.
    body: bytes  # Encoded message.
    credits: Mapping[str, int]
    backlog: Mapping[str, int]

    @classmethod
    def of(cls, topic: str, body: bytes | memoryview, situation: FlowStatus) -> "LoggedInput":
        """Create the log entry of a message.

        Args:
            topic: Name of the topic; empty for idle work.
            body: Encoded message.
            situation: Flow status of the actor before the step that handles the message.
        """
        credits = {topic.name: count for topic, count in situation.credits.items()}
        backlog = {topic.name: count for topic, count in situation.backlog.items()}
        return cls(topic, bytes(body), credits, backlog)

    def situation(self, actor: Actor) -> FlowStatus:
        """Return the flow status of the step, with topics instead of topic names as keys."""
        return FlowStatus(
            credits=counts_by_topic(self.credits, (out.topic for out in actor.outputs)),
            backlog=counts_by_topic(self.backlog, (port.topic for port in actor.inputs)),
        )


def logged_input(actor: Actor, delivery: Delivery | None) -> LoggedInput | None:
    """Return the write-ahead log entry of an actor's step; None if `actor.lags` is False.

    Args:
        actor: The actor, with the flow status of the step.
        delivery: Input of the step; None for idle work.
    """
    if not actor.lags:
        return None
    topic, body = (delivery.port.topic.name, delivery.body) if delivery else ("", b"")
    return LoggedInput.of(topic, body, actor.situation)


@dataclass(frozen=True)
class RestoredState:
    """Saved state, split into the actor's state and the delivery state."""

    own: State = field(default_factory=dict)  # State of the actor.
    inputs: Mapping[str, InletPosition] = field(default_factory=dict)  # Position by topic name.
    outputs: Mapping[str, OutletPosition] = field(default_factory=dict)  # Position by topic name.
    taken: tuple[LoggedInput, ...] = ()  # Write-ahead log: inputs handled after `own`.
    is_none: bool = False  # True if no state was saved.

    @classmethod
    def of(cls, state: State | None) -> "RestoredState":
        """Split a saved state into the actor's state and the delivery state.

        Args:
            state: State that the store has loaded; None or empty if no state was saved.
        """
        if not state:
            return cls(is_none=True)
        links = state.get(OFFSETS, {"in": {}, "out": {}})  # Absent without lossless links.
        return cls(
            own={part: value for part, value in state.items() if not part.startswith("stage.")},
            inputs={topic: InletPosition(*past) for topic, past in links["in"].items()},
            outputs={
                topic: OutletPosition(epoch, seq, tuple(_sent(state, topic)), logged_from)
                for topic, (epoch, seq, logged_from) in links["out"].items()
            },
            taken=tuple(LoggedInput(*state[part]) for part in _numbered(state, WAL)),
        )

    @property
    def of_actor(self) -> State:
        """State of the actor and its logged inputs, which together determine its next steps."""
        return {**self.own, **{f"{WAL} {n}": one for n, one in enumerate(self.taken)}}

    @property
    def has_passed(self) -> bool:
        """True if the stage has handled or produced a message of a lossless topic."""
        handled = any(past.handled for past in self.inputs.values())
        return handled or any(past.seq for past in self.outputs.values())


class DeliveryState:
    """Builder of the saved state of a stage: actor's state, offsets, outbox and write-ahead log.

    The saved state consists of named parts. An unchanged part stays the same object, so that the
    store does not write it again.
    """

    def __init__(self) -> None:
        self._links: dict[str, Any] = {}
        self._own: State = {}
        self._taken: dict[str, LoggedInput] = {}
        self._number = 0

    @property
    def is_long(self) -> bool:
        """True if the write-ahead log has reached its maximum length."""
        return len(self._taken) >= MAX_WAL_ENTRIES

    def own(self, own: State, taken: LoggedInput | None, whole: bool) -> dict[str, Any]:
        """Return the actor's state and the write-ahead log, as parts to save.

        Args:
            own: State of the actor, by part.
            taken: Input of the last step; None if `Actor.lags` is False. The `own` of such an actor
                always includes the last step.
            whole: True if `own` is a checkpoint, which includes the last step.

        Returns:
            The parts of `own` and the entries of the log. The log has the inputs of the steps that
            `own` does not include. The log is empty if `whole` is True. It is also empty if a part
            of `own` is a new object since the last call: `own` then includes all steps.
        """
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
        """Return the offsets and the outbox as parts to save; empty without lossless links."""
        if not inputs and not outputs:
            return {}
        places = {
            "in": dict(inputs),
            "out": {
                topic: (past.epoch, past.seq, past.logged_from) for topic, past in outputs.items()
            },
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
    """Restore a new actor to the end of the last saved step.

    The actor handles the logged inputs again to rebuild its state. The resulting outputs are
    discarded, because the outbox has them already. If the handling of an input raises an exception,
    the function starts again with another new actor and without this input.

    Args:
        actor: A new actor.
        past: The saved state.
        make: Function that creates another new actor.

    Returns:
        The restored actor: `actor`, or the one that was created last.
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
    """Handle logged inputs again, and return the index of the first that fails, or None."""
    kinds = {port.topic.name: port.topic.message for port in actor.inputs}
    for number, one in enumerate(taken):
        actor.situation = one.situation(actor)
        try:
            produce(actor, _messages(actor, one, kinds))
        except Exception:
            log.exception(
                "%s: replaying a logged input of %s failed; the actor continues without this "
                "message.",
                actor.name, one.topic,
            )  # fmt: skip
            return number
    return None


def _messages(
    actor: Actor, one: LoggedInput, kinds: Mapping[str, type[Message] | None]
) -> Iterable[Message]:
    if not one.topic:
        return actor.on_idle()
    kind = kinds[one.topic]
    assert kind is not None
    return actor.handle(decode(one.body, kind))


def counts_by_topic(counts: Mapping[str, int], topics: Iterable[Topic]) -> dict[Topic, int]:
    """Return `counts` with topics instead of names as keys; leave out topics without a count."""
    return {topic: counts[topic.name] for topic in topics if topic.name in counts}


def _sent_part(topic: str) -> str:
    return f"{OUTBOX} {topic.replace('/', '.')}"


def _sent(state: State, topic: str) -> Iterator[UnackedMessage]:
    for part in _numbered(state, _sent_part(topic)):
        yield UnackedMessage(*state[part])


def _numbered(state: State, kind: str) -> list[str]:
    """Return the names of the parts `<kind> <number>`, sorted by number."""
    parts = [part for part in state if part.rpartition(" ")[0] == kind]
    return sorted(parts, key=lambda part: int(part.rpartition(" ")[2]))
