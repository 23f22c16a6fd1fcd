"""How a stage is: sent twice a second, whether it works or waits."""

from typing import Literal

import msgspec

from ldo_service.schemas.message import Message, require_count, require_finite


class InputCount(msgspec.Struct, frozen=True, kw_only=True):
    """Counted since the stage started."""

    topic: str
    delivered: int  # handled by the actor
    dropped: int  # displaced by newer ones, by the input's policy
    rejected: int  # did not decode or did not pass the checks
    gaps: int  # lossless only: came out of order and was asked for again
    queued: int  # in the mailbox now
    peak_queued: int  # most that ever waited
    dropped_paused: int = 0  # left out while the service was paused
    lost: int = 0  # not lossless only: never came, by the numbers of those that did


class OutputCount(msgspec.Struct, frozen=True, kw_only=True):
    topic: str
    sent: int
    backpressure_waits: int  # times the stage waited for a consumer's window
    evicted_consumers: int  # consumers whose window stayed shut
    retransmitted: int = 0  # lossless messages sent again, because they got lost


class Health(Message, frozen=True, kw_only=True):
    """health/<actor>. stamp_ns is that of the last message handled."""

    actor: str
    state: Literal["starting", "ready", "busy", "draining"]
    pid: int
    epoch: int  # of the stage: changes when its process was restarted
    steps: int  # messages handled
    failures: int  # exceptions in the handler
    restarts: int  # times the actor was rebuilt from its last state
    dead_lettered: int  # messages that made it fail twice
    step_age_s: float  # since the last step finished
    current_step_s: float  # age of the step under way, 0 when waiting
    step_ms_p50: float  # over the last steps, but those that only took note of a message
    step_ms_p95: float
    rss_mb: float  # of the process
    inputs: tuple[InputCount, ...]
    outputs: tuple[OutputCount, ...]
    metrics: dict[str, float] = {}  # what the actor counts itself
    paused: bool = False  # takes nothing, on request

    def check(self) -> None:
        for name in ("pid", "epoch", "steps", "failures", "restarts", "dead_lettered"):
            require_count(name, getattr(self, name))
        times = (self.step_age_s, self.current_step_s, self.step_ms_p50, self.step_ms_p95)
        require_finite("health", (*times, self.rss_mb, *self.metrics.values()))
