"""Counters and step times of a stage, for its health message."""

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Literal

import numpy as np

from ldo_service.schemas import Health, Message

from ._heartbeat import Heartbeat
from .process import available_memory_mb, resident_mb
from .supervision_policy import RunningClock, monotonic_s

# Consecutive dead letters after which an actor counts as failing: one or two have their cause in
# the messages, more of them in the actor.
FAILING_AFTER = 3


@dataclass
class StageMetrics:
    """Counters and step times of a stage; fields ending in `_at_s` are monotonic times, seconds."""

    heartbeat: Heartbeat | None = None  # Heartbeat of this process, if a parent process reads it.
    state: Literal["starting", "ready", "draining"] = "starting"
    steps: int = 0  # Messages handled.
    failures: int = 0  # Exceptions in handlers, restores and final messages, and failed saves.
    restarts: int = 0  # Restores of the actor after a failure, in this process.
    dead_lettered: int = 0  # Messages that failed twice.
    dead_lettered_in_a_row: int = 0  # Dead letters since the last message that was handled.
    quarantined: int = 0  # Messages that ended the process repeatedly, since the first start.
    # Durations of the last 200 timed steps, ms; see `record_step`.
    step_ms: deque[float] = field(default_factory=lambda: deque(maxlen=200))
    last_step_ms: float = 0.0  # Duration of the last step, ms.
    last_stamp_ns: int = 0  # Stamp of the last handled message.
    finished_at_s: float = field(default_factory=monotonic_s)  # End of the last step or its save.
    started_at_s: float | None = None  # Start of the current step; None between steps.
    facts: dict[str, float] = field(
        default_factory=dict
    )  # The actor's metrics after its last step.
    clock: RunningClock = field(default_factory=RunningClock)  # Clock of `started_at_s`.

    @contextmanager
    def step(self) -> Iterator[None]:
        """Measure the duration of the step that runs in the `with` block, unless it raises."""
        started_s = self.started_at_s = self.clock.now_s()
        if self.heartbeat is not None:
            self.heartbeat.begin()
        try:
            yield
            self.last_step_ms = 1e3 * (self.clock.now_s() - started_s)
        finally:
            # The stage saves the state after this, and must not look stalled meanwhile.
            self.finished_at_s = monotonic_s()
            self.started_at_s = None
            if self.heartbeat is not None:
                self.heartbeat.end()

    def record_step(self, message: Message, is_timed: bool) -> None:
        """Count a finished step.

        Args:
            message: Input of the step.
            is_timed: Whether to add the duration of the step to `step_ms`. It is False for a step
                that only stores its input, because such short steps would lower the percentiles.
        """
        self.steps += 1
        self.dead_lettered_in_a_row = 0
        if is_timed:
            self.step_ms.append(self.last_step_ms)
        self.last_stamp_ns = message.stamp_ns
        self.finished_at_s = monotonic_s()

    def record_dead_letter(self) -> None:
        """Count a message that failed twice."""
        self.dead_lettered += 1
        self.dead_lettered_in_a_row += 1

    @property
    def busy_s(self) -> float:
        """Seconds since the start of the current step; 0 between steps."""
        started_s = self.started_at_s
        return 0.0 if started_s is None else max(self.clock.now_s() - started_s, 0.0)

    def health(self, **of_the_stage: Any) -> Health:
        """Return the health message of the stage.

        Args:
            **of_the_stage: Fields of the message that this object does not have.
        """
        median_ms, slow_ms = np.percentile(self.step_ms or [0.0], (50, 95)).tolist()
        facts, available_mb = self.facts, available_memory_mb()
        if available_mb is not None:
            facts = {**facts, "memory_available_mb": available_mb}
        is_busy = self.started_at_s is not None and self.state == "ready"
        return Health(
            stamp_ns=self.last_stamp_ns,
            state="busy" if is_busy else self.state,
            pid=os.getpid(),
            steps=self.steps,
            failures=self.failures,
            restarts=self.restarts,
            dead_lettered=self.dead_lettered,
            step_age_s=monotonic_s() - self.finished_at_s,
            current_step_s=self.busy_s,
            step_ms_p50=median_ms,
            step_ms_p95=slow_ms,
            rss_mb=resident_mb(),
            # A metric that is no number must not suppress the heartbeat.
            metrics={name: value for name, value in facts.items() if isfinite(value)},
            failing=self.dead_lettered_in_a_row >= FAILING_AFTER,
            quarantined=self.quarantined,
            **of_the_stage,
        )
