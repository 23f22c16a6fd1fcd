"""Heartbeat of an actor, published twice a second, even while the actor has nothing to do."""

from typing import Literal

import msgspec

from ldo_service.schemas.message import Message, require_count, require_finite


class InputCount(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of an input of an actor, from the start of the process of the actor."""

    topic: str
    delivered: int  # Messages handled by the actor.
    dropped: int  # Messages that the policy of the input dropped because newer ones arrived.
    rejected: int  # Messages that failed to decode or to pass the checks.
    gaps: int  # Lossless inputs only: gaps in the sequence, for which retransmission was requested.
    queued: int  # Messages in the mailbox now.
    peak_queued: int  # Maximum of `queued` so far.
    dropped_paused: int = 0  # Messages dropped while the service was paused.
    # Messages that never arrived, counted by gaps in the sequence. For lossless inputs, it counts
    # the messages that the producer had to drop.
    lost: int = 0


class OutputCount(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of an output of an actor, from the start of the process of the actor."""

    topic: str
    sent: int
    backpressure_waits: int  # Number of waits because a consumer's window was full.
    evicted_consumers: int  # Consumers evicted because their window stayed full.
    # Lossless messages sent again, after a loss or from a backlog.
    retransmitted: int = 0
    # Number of messages not handled yet by each consumer with a backlog, by consumer name.
    behind: dict[str, int] = {}
    backlog_mb: float = 0.0  # Size of the backlog on disk, MB.
    backlog_dropped: int = 0  # Messages dropped because the backlog had its maximum size.
    backlog_max_mb: float = 0.0  # Maximum size of the backlog, MB; 0: no maximum.


class Health(Message, frozen=True, kw_only=True):
    """Heartbeat of an actor, published on health/<actor>.

    A stage is the runtime around an actor, and publishes its heartbeat. stamp_ns is the stamp of
    the last message that the actor handled.
    """

    actor: str
    # busy: in a step. draining: handling its last messages before it stops.
    state: Literal["starting", "ready", "busy", "draining"]
    pid: int
    # Number of this process of the actor; it changes with each restart and reset. In the
    # attachments of other topics, the epoch stays the same if the actor continues from its state.
    epoch: int
    steps: int  # Handled messages.
    failures: int  # Exceptions in the handler.
    restarts: int  # Number of times that the actor was rebuilt from its last state.
    dead_lettered: int  # Messages that failed twice.
    step_age_s: float  # Time since the last step finished.
    current_step_s: float  # Age of the current step; 0 while waiting.
    step_ms_p50: float  # Median duration of recent steps, except steps that only store a message.
    step_ms_p95: float  # 95th percentile of the same durations.
    rss_mb: float  # Resident memory of the process.
    inputs: tuple[InputCount, ...]
    outputs: tuple[OutputCount, ...]
    metrics: dict[str, float] = {}  # Metrics of the actor by name.
    paused: bool = False  # True while the stage takes no messages, after the command `pause`.
    failing: bool = False  # True if each of the last three messages failed twice.
    # Messages that ended the actor's process repeatedly and are saved instead of handled, since the
    # first start of the service with this state folder.
    quarantined: int = 0

    def check(self) -> None:
        for name in (
            "pid",
            "epoch",
            "steps",
            "failures",
            "restarts",
            "dead_lettered",
            "quarantined",
        ):
            require_count(name, getattr(self, name))
        times = (self.step_age_s, self.current_step_s, self.step_ms_p50, self.step_ms_p95)
        require_finite("health", (*times, self.rss_mb, *self.metrics.values()))
