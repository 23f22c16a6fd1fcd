"""Actors and their ports.

An actor has input and output ports, a handler, and state that can be saved and restored. The
delivery policy belongs to the input: only a consumer knows whether a late message is still worth
something.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ldo_service.errors import ConfigError
from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State

UNLIMITED = 1 << 30


@dataclass(frozen=True, slots=True)
class Lossless:
    """Every message arrives, in order; the producer waits for room."""

    window: int = 8  # messages that may be under way; bounds memory at both ends

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ConfigError(f"Lossless(window={self.window}): must be at least 1.")

    def __str__(self) -> str:
        return f"Lossless({self.window})"


@dataclass(frozen=True, slots=True)
class Latest:
    """The newest `depth` messages wait; older ones are dropped and counted.

    With `per_key`, the newest `depth` for each value of the topic's key, at most `max_keys` values:
    the oldest value makes room for a new one.
    """

    depth: int = 1
    per_key: bool = False
    max_keys: int = 32

    def __post_init__(self) -> None:
        if self.depth < 1 or self.max_keys < 1:
            raise ConfigError(
                f"Latest(keep={self.depth}, max_keys={self.max_keys}): both must be at least 1."
            )

    def __str__(self) -> str:
        return f"Latest({self.depth} per key)" if self.per_key else f"Latest({self.depth})"


Policy = Lossless | Latest


@dataclass(frozen=True, slots=True)
class In:
    """`has_priority`: what comes here is taken before all that waits at other inputs."""

    topic: Topic
    policy: Policy
    has_priority: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.policy, Latest) and self.policy.per_key and self.topic.key is None:
            raise ConfigError(f"{self.topic.name} has no key: Latest(per_key=True) cannot be used.")


@dataclass(frozen=True, slots=True)
class Out:
    """`is_nonblocking`: the actor looks at `credits` before it makes a message, and never waits for
    it."""

    topic: Topic
    is_nonblocking: bool = False


@dataclass(frozen=True, slots=True)
class FlowStatus:
    """What an actor sees of the traffic around it; with the message, all that a step depends on.

    room     for each output that never waits: how many messages may be sent now
    waiting  for each lossless input: how many messages wait behind the one that is handled
    """

    credits: Mapping[Topic, int] = field(default_factory=dict)
    backlog: Mapping[Topic, int] = field(default_factory=dict)


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
        self.situation = FlowStatus()

    def has_credit(self, topic: Topic) -> bool:
        return self.situation.credits.get(topic, UNLIMITED) > 0

    def handle(self, message: Any) -> Iterator[Message]:
        """What the actor makes of one message of its inputs."""
        raise NotImplementedError

    def on_restored(self) -> Iterator[Message]:
        """First words of a successor: what a predecessor may have left unsaid to those outside."""
        return iter(())

    def on_stop(self) -> Iterator[Message]:
        """Last words before a soft stop. `finishes_last`: after all others have said theirs."""
        return iter(())

    def snapshot(self) -> State:
        """What a successor needs to go on; called after every step, so it must be cheap."""
        return {}

    def checkpoint(self) -> State:
        """The same with nothing left for later, however long it takes; on request."""
        return self.snapshot()

    def on_saved(self) -> None:
        """The last snapshot or checkpoint is where a successor will find it."""

    def restore(self, state: State) -> None:
        """Go on from a predecessor's snapshot."""

    def metrics(self) -> dict[str, float]:
        """What the actor counts itself, for its health message."""
        return {}
