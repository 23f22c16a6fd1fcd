"""How often something may fail before it is given up."""

from collections import deque

from ldo_service.errors import RestartsExhausted


class RestartBudget:
    """At most `max_restarts` within `window_s`; each restart in the window waits twice as long."""

    def __init__(
        self, name: str, max_restarts: int, window_s: float, delay_s: float, delay_max_s: float
    ) -> None:
        self._name, self._max_restarts, self._window_s = name, max_restarts, window_s
        self._delay_s, self._delay_max_s = delay_s, delay_max_s
        self._failed_at_s: deque[float] = deque()

    def spend(self, now_s: float) -> float:
        """Count a failure; the delay before the restart. Raises RestartsExhausted."""
        self._failed_at_s.append(now_s)
        while self._failed_at_s[0] < now_s - self._window_s:
            self._failed_at_s.popleft()
        recent = len(self._failed_at_s)
        if recent > self._max_restarts:
            raise RestartsExhausted(self._name, recent, self._window_s)
        return min(self._delay_s * 2.0 ** min(recent - 1, 60), self._delay_max_s)
