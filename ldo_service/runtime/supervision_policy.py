"""Limits of supervision: step timeouts, restart budgets and back-off."""

from collections import deque
from dataclasses import dataclass

from ldo_service.errors import ConfigError, RestartsExhausted, named


class RestartBudget:
    """Restart budget of an actor: at most `max_restarts` within `window_s`.

    The delay before a restart doubles with each failure in the window.
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

        Raises:
            RestartsExhausted: The budget is used up.
        """
        self._failed_at_s.append(now_s)
        while self._failed_at_s[0] < now_s - self._window_s:
            self._failed_at_s.popleft()
        recent = len(self._failed_at_s)
        if recent > self._max_restarts:
            raise RestartsExhausted(self._name, recent, self._window_s)
        return min(self._delay_s * 2.0 ** min(recent - 1, 60), self._delay_max_s)


@dataclass(frozen=True, slots=True)
class SupervisionConfig:
    """Limits of supervision for all stages and child processes."""

    # Maximum restarts within `restart_window_s`; a restart does not cure a more frequent fault.
    max_restarts: int = 5
    restart_window_s: float = 60.0
    restart_delay_s: float = 0.05  # Doubled with each failure in the window.
    restart_delay_max_s: float = 5.0
    heartbeat_s: float = 0.5  # Heartbeat period.
    # Maximum duration of a step, seconds: 100x the slowest one measured (mapper, 1.5 M Gaussians).
    stall_after_s: float = 60.0
    # The same limit for actors that no other actor waits for: one optimization may take minutes.
    backend_stall_after_s: float = 600.0
    # Maximum size on disk of the unhandled messages of one topic, MB: almost 8 minutes of
    # keyframes of 640x480 at 2 Hz.
    backlog_mb: float = 2000.0
    # Time without progress after which a consumer is evicted, because its producer waits for it.
    evict_after_s: float = 30.0
    # Nice value of threads with work that may be late. On a shared core (Linux) they have a
    # tenth of the weight of threads that a robot waits for.
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
                + " must be positive; max_restarts and the delays may be 0."
            )
        if not 0 <= self.nice <= 19:
            raise ConfigError(f"supervision.background_nice={self.nice} must be within 0..19.")

    def step_limit(self, is_backend: bool) -> tuple[float, str]:
        """Return the maximum duration of a step in seconds, and the name of its setting."""
        if is_backend:
            return self.backend_stall_after_s, "supervision.backend_step_timeout_s"
        return self.stall_after_s, "supervision.step_timeout_s"
