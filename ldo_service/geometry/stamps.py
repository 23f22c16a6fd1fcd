"""Association of measurements by their time stamps, online and between complete lists.

Conventions: `ldo_service.geometry`.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np

from ldo_service.errors import ConfigError, FrameError

REMEMBERED_INTERVALS = 8  # the smallest of them is the stream's period: dropped halves make longer
RECENT_PAIRS = 200  # that the statistics of skew are taken over: 7 s at 30 Hz


def associate(stamps_a: np.ndarray, stamps_b: np.ndarray, tolerance: float) -> np.ndarray:
    """Index pairs [M, 2] of stamps at most `tolerance` apart, each used once, ascending in a.

    The closest pair is taken first, then the closest of what is left, as TUM's `associate.py`
    does. Both lists may be unsorted; all three arguments share one unit (ns or s).
    """
    candidates = _candidates(stamps_a, stamps_b, tolerance)
    gaps = np.abs(stamps_a[candidates[:, 0]] - stamps_b[candidates[:, 1]])
    free_a, free_b = np.ones(len(stamps_a), bool), np.ones(len(stamps_b), bool)
    pairs = []
    for i, j in candidates[np.argsort(gaps, kind="stable")]:
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), int).reshape(-1, 2)


def _candidates(stamps_a: np.ndarray, stamps_b: np.ndarray, tolerance: float) -> np.ndarray:
    """All index pairs [C, 2] at most `tolerance` apart."""
    order = np.argsort(stamps_b, kind="stable")
    sorted_b = stamps_b[order]
    first = np.searchsorted(sorted_b, stamps_a - tolerance, side="left")
    last = np.searchsorted(sorted_b, stamps_a + tolerance, side="right")
    rows = [(i, j) for i in range(len(stamps_a)) for j in order[first[i] : last[i]]]
    return np.array(rows, int).reshape(-1, 2)


class Stamped(Protocol):
    @property
    def stamp_ns(self) -> int: ...


A = TypeVar("A", bound=Stamped)
B = TypeVar("B", bound=Stamped)


@dataclass
class StreamBuffer:
    """One stream: what waits for its other half, the oldest first."""

    waiting: deque[Stamped] = field(default_factory=deque)
    stamps_ns: deque[int] = field(
        default_factory=lambda: deque(maxlen=REMEMBERED_INTERVALS + 1)  # the newest that came
    )
    lost: int = 0

    def add(self, half: Stamped) -> None:
        if self.stamps_ns and half.stamp_ns <= self.stamps_ns[-1]:
            raise FrameError(
                f"its stamp {half.stamp_ns} ns is not after the last one of its stream, "
                f"{self.stamps_ns[-1]} ns. Send halves in the order of their exposure; after the "
                "camera's clock was set back, start anew with `ldo control reset`."
            )
        self.stamps_ns.append(half.stamp_ns)
        self.waiting.append(half)

    def lose(self) -> None:
        self.waiting.popleft()
        self.lost += 1

    def period_ns(self) -> int | None:
        """The smallest recent interval; None before there are two stamps."""
        return min((b - a for a, b in pairwise(self.stamps_ns)), default=None)


class StreamPairer(Generic[A, B]):
    """Pairs each half with the nearest of the other stream, at most `max_skew_ns` away.

    Pairs keep the order of both streams, and each half is used once. A pair is given out as soon
    as nothing nearer can come: at once when stamps are equal or differ by at most half the period
    of the stream that is behind, else with that stream's next half. Before a stream's period is
    known the first within reach is taken. No more than `buffer` halves of a stream wait: then the
    oldest is paired with what there is, or lost. Equal input gives equal pairs: no clock is read.
    """

    def __init__(self, max_skew_ns: int, buffer: int) -> None:
        if max_skew_ns < 0 or buffer < 1:
            raise ConfigError(
                f"pairing within {max_skew_ns} ns, {buffer} waiting: must be at least 0 and 1."
            )
        self._max_skew_ns, self._buffer = max_skew_ns, buffer
        self._a, self._b = StreamBuffer(), StreamBuffer()
        self._skews_ns: deque[int] = deque(maxlen=RECENT_PAIRS)
        self.pairs = 0

    def add_a(self, half: A) -> Iterator[tuple[A, B]]:
        """The pairs that this half decides. Raises FrameError when its stamp goes back."""
        self._a.add(half)
        return self._decided()

    def add_b(self, half: B) -> Iterator[tuple[A, B]]:
        """The pairs that this half decides. Raises FrameError when its stamp goes back."""
        self._b.add(half)
        return self._decided()

    @property
    def lost_a(self) -> int:
        return self._a.lost

    @property
    def lost_b(self) -> int:
        return self._b.lost

    def skews_ms(self) -> list[float]:
        """Distances of the recent pairs' stamps."""
        return [skew * 1e-6 for skew in self._skews_ns]

    def _decided(self) -> Iterator[tuple[A, B]]:
        a, b = self._a.waiting, self._b.waiting
        while a and b:
            skew = abs(a[0].stamp_ns - b[0].stamp_ns)
            earlier = self._a if a[0].stamp_ns < b[0].stamp_ns else self._b
            later = self._b if earlier is self._a else self._a
            if skew > self._max_skew_ns or self._has_nearer(earlier, later, skew):
                earlier.lose()
            elif self._may_get_nearer(earlier, skew) and len(later.waiting) <= self._buffer:
                return
            else:
                self.pairs += 1
                self._skews_ns.append(skew)
                yield a.popleft(), b.popleft()  # type: ignore[misc]
        for half in (self._a, self._b):
            while len(half.waiting) > self._buffer:
                half.lose()

    @staticmethod
    def _has_nearer(earlier: StreamBuffer, later: StreamBuffer, skew: int) -> bool:
        """Whether the half after the earlier one is nearer to the later one."""
        target = later.waiting[0].stamp_ns
        return len(earlier.waiting) > 1 and abs(earlier.waiting[1].stamp_ns - target) < skew

    @staticmethod
    def _may_get_nearer(earlier: StreamBuffer, skew: int) -> bool:
        """Whether a half that is still to come may be nearer than the earlier one."""
        period = earlier.period_ns()
        return len(earlier.waiting) == 1 and period is not None and 2 * skew > period
