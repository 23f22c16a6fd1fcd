"""Limits of supervision: step timeouts, restart budgets, restart delays and log rate limits."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ldo_service.errors import ConfigError, RestartsExhausted, named


def monotonic_s() -> float:
    """Return the time of the monotonic clock, seconds.

    The runtime uses this function instead of `time.monotonic`, so that a simulation can replace
    the clock.
    """
    return time.monotonic()


class RestartBudget:
    """Restart budget of an actor: at most `max_restarts` restarts within `window_s` seconds.

    The delay before a restart doubles with each failure in these `window_s` seconds.
    """

    def __init__(
        self, name: str, max_restarts: int, window_s: float, delay_s: float, delay_max_s: float
    ) -> None:
        self._name, self._max_restarts, self._window_s = name, max_restarts, window_s
        self._delay_s, self._delay_max_s = delay_s, delay_max_s
        self._failed_at_s: deque[float] = deque()

    @staticmethod
    def of(name: str, config: "SupervisionConfig") -> "RestartBudget":
        """Return the restart budget of an actor with the limits of `config`."""
        return RestartBudget(
            name,
            config.max_restarts,
            config.restart_window_s,
            config.restart_delay_s,
            config.restart_delay_max_s,
        )

    def record_failure(self, now_s: float) -> float:
        """Count a failure and return the delay before the restart, in seconds.

        Args:
            now_s: Event-loop time of the failure, seconds.

        Raises:
            RestartsExhausted: The budget is used up.
        """
        self._failed_at_s.append(now_s)
        delay_s = self.delay_s(now_s)
        if (recent := len(self._failed_at_s)) > self._max_restarts:
            raise RestartsExhausted(self._name, recent, self._window_s)
        return delay_s

    def delay_s(self, now_s: float) -> float:
        """Return the delay before a restart, in seconds, without counting a failure.

        Args:
            now_s: Event-loop time of the restart, seconds.
        """
        while self._failed_at_s and self._failed_at_s[0] < now_s - self._window_s:
            self._failed_at_s.popleft()
        recent = max(len(self._failed_at_s), 1)
        return min(self._delay_s * 2.0 ** min(recent - 1, 60), self._delay_max_s)


# Minimum time between two log lines of one kind that messages or a bad disk can cause, seconds.
LOG_PERIOD_S = 60.0


class LogLimit:
    """Rate limit for a log line that messages from outside can cause: one line per period.

    Args:
        period_s: Minimum time between two lines, seconds.
        clock: Monotonic clock, seconds.
    """

    def __init__(self, period_s: float, clock: Callable[[], float] = monotonic_s) -> None:
        self._period_s, self._clock = period_s, clock
        self._due_at_s = float("-inf")

    def is_due(self) -> bool:
        """Return True at most once per period; on True, the caller writes its log line."""
        now_s = self._clock()
        if now_s < self._due_at_s:
            return False
        self._due_at_s = now_s + self._period_s
        return True


class RunningClock:
    """Monotonic clock that stands still while this process does not run.

    A process does not run while it is suspended (SIGSTOP), while its container is paused, or while
    its virtual machine is migrated. Such a pause must not make a step look as if it hangs. `tick`
    is called periodically; a late call shows that the process was paused.
    """

    # Delay of a call of `tick`, in seconds, above which the process was paused. A busy machine
    # causes smaller delays.
    MAX_LATE_S = 2.0

    def __init__(self, clock: Callable[[], float] = monotonic_s) -> None:
        self._clock = clock
        self._last_s: float | None = None
        self._stopped_s = 0.0

    def tick(self, period_s: float) -> float:
        """Record that the process runs; call this method every `period_s` seconds.

        Returns:
            Time for which the process was paused since the last call, seconds; usually 0.
        """
        now_s = self._clock()
        late_s = 0.0 if self._last_s is None else now_s - self._last_s - period_s
        self._last_s = now_s
        if late_s <= self.MAX_LATE_S:
            return 0.0
        self._stopped_s += late_s
        return late_s

    def now_s(self) -> float:
        """Return the time in seconds; only the difference of two results has a meaning."""
        return self._clock() - self._stopped_s


@dataclass(frozen=True, slots=True)
class SupervisionConfig:
    """Limits of supervision for all stages and child processes."""

    # Maximum restarts within `restart_window_s`; a restart does not cure a more frequent fault.
    max_restarts: int = 5
    restart_window_s: float = 60.0  # Time window of `max_restarts`, seconds.
    # Delay before a restart, seconds. It doubles with each failure in the window up to the maximum.
    restart_delay_s: float = 0.05
    restart_delay_max_s: float = 5.0
    heartbeat_s: float = 0.5  # Heartbeat period.
    # Maximum duration of a step, seconds: a hundred times the slowest one measured (mapper with 1.5
    # million Gaussians).
    stall_after_s: float = 60.0
    # Maximum duration of a step of an actor that no other actor waits for, seconds. One
    # optimization may take minutes.
    backend_stall_after_s: float = 600.0
    # Maximum size on disk of the unhandled messages of one topic, MB: almost 8 minutes of
    # keyframes of 640x480 at 2 Hz.
    backlog_mb: float = 2000.0
    # Time in seconds after which a consumer without progress is evicted, so that its producer no
    # longer waits for it.
    evict_after_s: float = 30.0
    # Nice value of threads whose work may be late. On a shared core under Linux, such a thread gets
    # a tenth of the computing time of a thread that a robot waits for.
    nice: int = 10
    # Maximum size of a message that is decoded, MB; raw color and depth of 8 MP have 58 MB.
    max_message_mb: float = 64.0

    def __post_init__(self) -> None:
        times = (
            *(self.restart_window_s, self.heartbeat_s, self.stall_after_s),
            *(self.backend_stall_after_s, self.evict_after_s),
        )
        if (
            min(*times, self.max_message_mb, self.backlog_mb) <= 0
            or min(self.max_restarts, self.restart_delay_s, self.restart_delay_max_s) < 0
        ):
            raise ConfigError(
                named(
                    self,
                    "max_restarts",
                    "restart_window_s",
                    "restart_delay_s",
                    "restart_delay_max_s",
                    "heartbeat_s",
                    "stall_after_s",
                    "backend_stall_after_s",
                    "evict_after_s",
                    "max_message_mb",
                    "backlog_mb",
                )
                + ": max_restarts, restart_delay_s and restart_delay_max_s must be at least 0, "
                "and the other settings must be positive."
            )
        if not 0 <= self.nice <= 19:
            raise ConfigError(f"supervision.background_nice={self.nice} must be within 0..19.")

    def step_limit(self, is_backend: bool) -> tuple[float, str]:
        """Return the maximum duration of a step in seconds, and the name of its setting.

        Args:
            is_backend: Whether no other actor waits for the outputs of the step's actor.
        """
        if is_backend:
            return self.backend_stall_after_s, "supervision.backend_step_timeout_s"
        return self.stall_after_s, "supervision.step_timeout_s"
