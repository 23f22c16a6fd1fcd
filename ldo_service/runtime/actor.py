"""What an actor is: ports, a handler, and state that can be put away and taken up again."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State

from .ports import In, Out

UNLIMITED = 1 << 30


@dataclass(frozen=True, slots=True)
class Situation:
    """What an actor sees of the traffic around it; with the message, all that a step depends on.

    room     for each output that never waits: how many messages may be sent now
    waiting  for each lossless input: how many messages wait behind the one that is handled
    """

    room: Mapping[Topic, int] = field(default_factory=dict)
    waiting: Mapping[Topic, int] = field(default_factory=dict)


class Actor:
    """One box of the design card. `situation` is set before each step."""

    name: ClassVar[str]
    inputs: ClassVar[tuple[In, ...]] = ()
    outputs: ClassVar[tuple[Out, ...]] = ()
    lags = False  # its snapshots may be of an earlier step: what it took since is kept beside them
    finishes_last = False  # its last words tell what came of the others'
    # asks what no journal records: a replay leaves it out, and who takes what it makes is fed from
    # what it took then
    talks_outside = False
    is_prompt = False  # a robot waits for what it makes: its thread comes before those of others

    def __init__(self) -> None:
        self.situation = Situation()

    def has_room(self, topic: Topic) -> bool:
        return self.situation.room.get(topic, UNLIMITED) > 0

    def handle(self, message: Any) -> Iterator[Message]:
        """What the actor makes of one message of its inputs."""
        raise NotImplementedError

    def resumed(self) -> Iterator[Message]:
        """First words of a successor: what a predecessor may have left unsaid to those outside."""
        return iter(())

    def finish(self) -> Iterator[Message]:
        """Last words before a soft stop. `finishes_last`: after all others have said theirs."""
        return iter(())

    def snapshot(self) -> State:
        """What a successor needs to go on; called after every step, so it must be cheap."""
        return {}

    def checkpoint(self) -> State:
        """The same with nothing left for later, however long it takes; on request."""
        return self.snapshot()

    def saved(self) -> None:
        """The last snapshot or checkpoint is where a successor will find it."""

    def restore(self, state: State) -> None:
        """Go on from a predecessor's snapshot."""

    def facts(self) -> dict[str, float]:
        """What the actor counts itself, for its health message."""
        return {}
