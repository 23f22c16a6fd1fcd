"""Actors and their ports.

An actor has input and output ports, a handler, and state that can be saved and restored. The
delivery policy belongs to the input: only the consumer knows whether a late message is still
useful.
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
    """Policy of an input that receives every message, in order; the producer waits for credit."""

    window: int = 8  # Maximum number of unhandled messages; bounds memory at both ends.

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ConfigError(f"Lossless.window={self.window} must be at least 1.")

    def __str__(self) -> str:
        return f"Lossless({self.window})"


@dataclass(frozen=True, slots=True)
class Latest:
    """Policy of an input that queues the newest messages; older ones are dropped and counted."""

    depth: int = 1  # Maximum number of queued messages; with `per_key`, for each key.
    per_key: bool = False  # Keep one queue for each value of the topic's key.
    max_keys: int = 32  # Maximum number of keys; a new key displaces the oldest one.

    def __post_init__(self) -> None:
        if self.depth < 1 or self.max_keys < 1:
            raise ConfigError(
                f"Latest.depth={self.depth}, Latest.max_keys={self.max_keys} must be at least 1."
            )

    def __str__(self) -> str:
        return f"Latest({self.depth} per key)" if self.per_key else f"Latest({self.depth})"


Policy = Lossless | Latest


@dataclass(frozen=True, slots=True)
class In:
    """Input port of an actor."""

    topic: Topic
    policy: Policy
    has_priority: bool = False  # Take its messages before those queued at other inputs.

    def __post_init__(self) -> None:
        if isinstance(self.policy, Latest) and self.policy.per_key and self.topic.key is None:
            raise ConfigError(
                f"Latest(per_key=True) needs a topic with a key, and {self.topic.name} has none. "
                "Set Topic.key or per_key=False."
            )


@dataclass(frozen=True, slots=True)
class Out:
    """Output port of an actor."""

    topic: Topic
    # The actor checks its credits before it produces a message; sending never waits.
    is_nonblocking: bool = False


@dataclass(frozen=True, slots=True)
class FlowStatus:
    """State of an actor's links before a step.

    A step depends on the actor's state, the message and this status, and on nothing else.

    Attributes:
        credits: Number of messages that may be sent now, for each nonblocking output.
        backlog: Number of messages queued behind the current one, for each lossless input.
    """

    credits: Mapping[Topic, int] = field(default_factory=dict)
    backlog: Mapping[Topic, int] = field(default_factory=dict)


class Actor:
    """Unit of computation that handles messages; the stage sets `situation` before each step."""

    name: ClassVar[str]
    inputs: ClassVar[tuple[In, ...]] = ()
    outputs: ClassVar[tuple[Out, ...]] = ()
    # Snapshots may be of an earlier step; the stage logs the inputs handled since.
    lags = False
    finishes_last = False  # The final messages depend on those of other actors.
    # The actor queries a source that no journal records. A replay skips the actor and feeds its
    # consumers from their own recorded inputs.
    talks_outside = False
    # A robot waits for the outputs, so the thread has priority over those of other actors.
    is_prompt = False

    def __init__(self) -> None:
        self.situation = FlowStatus()

    def has_credit(self, topic: Topic) -> bool:
        """Return whether a message of the topic may be sent without waiting."""
        return self.situation.credits.get(topic, UNLIMITED) > 0

    def handle(self, message: Any) -> Iterator[Message]:
        """Handle one input message and yield the output messages."""
        raise NotImplementedError

    def on_restored(self) -> Iterator[Message]:
        """Yield the restored messages.

        Called on an actor restored from a saved state. The previous process may have stopped before
        it published them.
        """
        return iter(())

    def on_stop(self) -> Iterator[Message]:
        """Yield the final messages before a soft stop.

        Actors with `finishes_last` publish theirs after all other actors.
        """
        return iter(())

    def snapshot(self) -> State:
        """Return the state that a restored actor needs to continue.

        The stage calls it after every step, so it must be cheap.
        """
        return {}

    def checkpoint(self) -> State:
        """Return the complete state, including all that `snapshot` may defer.

        It may take long; the stage calls it on request.
        """
        return self.snapshot()

    def on_saved(self) -> None:
        """Handle the notification that the last snapshot or checkpoint was written."""

    def restore(self, state: State) -> None:
        """Continue from a snapshot of an earlier actor."""

    def metrics(self) -> dict[str, float]:
        """Return the actor's own metrics for its health message, by name."""
        return {}
