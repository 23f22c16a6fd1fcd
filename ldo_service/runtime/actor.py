"""Actors and their ports.

An actor has input and output ports, a handler, and state that can be saved and restored. Each input
declares its delivery policy, because only the consumer knows whether a late message is still
useful.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from ldo_service.errors import ConfigError
from ldo_service.schemas import Message
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_store import State

UNLIMITED = 1 << 30


@dataclass(frozen=True, slots=True)
class Lossless:
    """Policy of an input that receives every message in order.

    The producer waits while the consumer has `window` unhandled messages.
    """

    window: int = 8  # Maximum number of messages sent but not handled; it bounds memory.

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ConfigError(f"Lossless.window={self.window} must be at least 1.")

    def __str__(self) -> str:
        return f"Lossless({self.window})"


@dataclass(frozen=True, slots=True)
class Backlog(Lossless):
    """Policy of an input that receives every message, although the producer never waits for it.

    The producer stores the messages that the consumer has not handled on its disk. A slow, stopped
    or dead consumer therefore delays no other actor. When the consumer continues, it receives the
    stored messages in order. Messages are lost only if they take more than
    `supervision.backlog_mb`: the producer then drops the oldest ones. `window` bounds only the
    consumer's queue in memory.
    """

    def __str__(self) -> str:
        return f"Backlog({self.window})"


@dataclass(frozen=True, slots=True)
class Latest:
    """Policy of an input that queues the newest messages; older ones are dropped and counted."""

    depth: int = 1  # Maximum number of messages in a queue.
    per_key: bool = False  # Keep one queue for each value of the field that `Topic.key` names.
    # Maximum number of queues. If a new key exceeds this number, the queue with the oldest
    # message is dropped.
    max_keys: int = 32

    def __post_init__(self) -> None:
        if self.depth < 1 or self.max_keys < 1:
            raise ConfigError(
                f"Latest.depth={self.depth} and Latest.max_keys={self.max_keys} must be at least 1."
            )

    def __str__(self) -> str:
        return f"Latest({self.depth} per key)" if self.per_key else f"Latest({self.depth})"


Policy = Lossless | Latest


@dataclass(frozen=True, slots=True)
class In:
    """Input port of an actor."""

    topic: Topic
    policy: Policy
    has_priority: bool = False  # Take messages of this input before those of other inputs.
    # False: the actor may finish before the producer of the topic does. Its own final messages
    # do not depend on the last messages of the topic.
    needs_final: bool = True

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
    # The actor checks `has_credit` before it produces a message, so that sending never waits.
    is_nonblocking: bool = False
    is_final: bool = False  # `on_stop` may yield messages of this topic.


@dataclass(frozen=True, slots=True)
class FlowStatus:
    """Credit of an actor's outputs and backlog of its inputs, measured before a step.

    The outputs of a step depend only on the actor's state, the message and this status.

    Attributes:
        credits: Number of messages that may be sent without waiting, for each nonblocking output.
        backlog: Number of messages queued behind the current one, for each lossless input.
    """

    credits: Mapping[Topic, int] = field(default_factory=dict)
    backlog: Mapping[Topic, int] = field(default_factory=dict)


class StateFiles(Protocol):
    """Files to which the saved state of an actor refers."""

    def saved(self) -> None:
        """Remove the files that the most recently saved snapshot does not need."""

    def kept(self, *, is_previous_complete: bool) -> None:
        """Remove the files that no generation of the state needs.

        A generation is a synced copy of the states of all actors, to which the service can fall
        back. The stage calls this method after each copy; see `runtime.generations`.

        Args:
            is_previous_complete: True if the generation before the newest one is complete.
                Otherwise, no file is removed, because the service may fall back to an older one.
        """

    def retired_bytes(self) -> int:
        """Return the size of the files that only older copies of the state need, bytes."""
        ...

    def unsynced_files(self) -> list[Path]:
        """Return the files that may not be on the disk yet."""
        ...

    def begin_sync(self) -> None:
        """Record that the stage starts to sync the files of the last `unsynced_files` call."""

    def end_sync(self) -> None:
        """Record that the files of the last `begin_sync` are on the disk."""


class Actor:
    """Unit of computation that handles messages.

    A step is the handling of one message. The stage is the runtime around the actor. Before each
    step, the stage sets `situation` to the credits of the outputs and the backlogs of the inputs.
    """

    name: ClassVar[str]
    inputs: ClassVar[tuple[In, ...]] = ()
    outputs: ClassVar[tuple[Out, ...]] = ()
    # True if `snapshot` may return the state of an earlier step. The stage then also saves the
    # inputs that the actor has handled since that step.
    lags = False
    # Time without messages after which the stage calls `on_idle`, seconds.
    idle_after_s = 0.2
    # True if the actor queries an external server, whose answers no journal records. A replay
    # therefore skips the actor, and feeds its consumers from their own recorded inputs.
    talks_outside = False
    # True if no other actor waits for the outputs. A step may then take minutes.
    is_backend = False
    # True if a robot waits for the outputs. This actor's thread then has priority over the
    # threads of other actors.
    is_prompt = False

    files: StateFiles | None = None  # Files to which the state refers; None: there are none.

    def __init__(self) -> None:
        self.situation = FlowStatus()

    def has_credit(self, topic: Topic) -> bool:
        """Return whether a message of the topic may be sent now.

        Only an output with `Out.is_nonblocking` needs this check. For any other output, the result
        is True, because the runtime itself waits until the message can be sent.
        """
        return self.situation.credits.get(topic, UNLIMITED) > 0

    def handle(self, message: Any) -> Iterator[Message]:
        """Handle one input message and yield the output messages."""
        raise NotImplementedError

    def on_restored(self) -> Iterator[Message]:
        """Yield the messages that a restored actor publishes before its first input.

        The stage calls this method after a restore from a saved state, because the previous process
        may have stopped before it published its last messages.
        """
        return iter(())

    def has_idle_work(self) -> bool:
        """Return whether `on_idle` has work to do; the stage calls this method between steps."""
        return False

    def on_idle(self) -> Iterator[Message]:
        """Do one part of the idle work, and yield the output messages.

        The stage calls this method while no message arrives. A message that arrives meanwhile waits
        until the part is done, so each part must be short.
        """
        return iter(())

    def on_stop(self) -> Iterator[Message]:
        """Yield the final messages of the actor.

        On a soft stop, the actor first handles all queued messages. Then the stage calls this
        method. The actors stop in the order of `actor_graph.finish_order`. Only messages of ports
        with `is_final` are allowed.
        """
        return iter(())

    def snapshot(self) -> State:
        """Return the state that a restored actor needs to continue.

        The stage calls this method after every step, so it must be cheap.
        """
        return {}

    def checkpoint(self) -> State:
        """Return the complete state, including changes that `snapshot` may omit.

        The call may take seconds. The stage calls this method for the command `save`, after
        `on_restored` and `on_stop`, and when its write-ahead log of inputs is full.
        """
        return self.snapshot()

    def on_saved(self) -> None:
        """Handle the notification that the last snapshot or checkpoint was written.

        If the service keeps copies of the state to which it can fall back (`runtime.generations`),
        the stage does not call this method. It calls `self.files.kept` instead.
        """
        if self.files is not None:
            self.files.saved()

    def restore(self, state: State) -> None:
        """Set the state of this new actor from a snapshot or checkpoint of an earlier instance."""

    def metrics(self) -> dict[str, float]:
        """Return the actor's own metrics for its health message, by name."""
        return {}
