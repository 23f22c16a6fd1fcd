"""Association of measurements by their time stamps, for live streams and for complete lists.

Conventions: `ldo_service.geometry`.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from ldo_service.errors import ConfigError, FrameError

# Number of recent intervals between stamps. The smallest interval counts as the period of the
# stream, because dropped measurements make other intervals longer.
REMEMBERED_INTERVALS = 8
RECENT_PAIRS = 200  # Number of pairs in the skew statistics: 7 s at 30 Hz.


def associate(stamps_a: np.ndarray, stamps_b: np.ndarray, tolerance: float) -> np.ndarray:
    """Match the stamps of two lists.

    The search is greedy as in TUM's `associate.py`: the closest pair is matched first, then the
    closest of the remaining stamps. All arguments have the same unit (ns or s).

    Args:
        stamps_a: Stamps, [A], sorted or not.
        stamps_b: Stamps, [B], sorted or not.
        tolerance: Maximum difference between the two stamps of a pair.

    Returns:
        Index pairs (a, b), [M, 2], ascending in a; each stamp occurs at most once.
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
    """Return all index pairs [C, 2] of stamps at most `tolerance` apart."""
    order = np.argsort(stamps_b, kind="stable")
    sorted_b = stamps_b[order]
    first = np.searchsorted(sorted_b, stamps_a - tolerance, side="left")
    last = np.searchsorted(sorted_b, stamps_a + tolerance, side="right")
    rows = [(i, j) for i in range(len(stamps_a)) for j in order[first[i] : last[i]]]
    return np.array(rows, int).reshape(-1, 2)


class Stamped(Protocol):
    """Measurement with a time stamp."""

    @property
    def stamp_ns(self) -> int:
        """Time stamp in nanoseconds."""
        ...


A = TypeVar("A", bound=Stamped)
B = TypeVar("B", bound=Stamped)


@dataclass
class StreamBuffer:
    """Buffer of measurements of one stream that wait for a partner from another stream."""

    waiting: deque[Stamped] = field(default_factory=deque)  # The oldest first.
    # The newest received stamps, including those of measurements already paired or dropped.
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_INTERVALS + 1))
    lost: int = 0  # Number of measurements that were dropped without a partner.

    def add(self, half: Stamped) -> None:
        """Add a measurement.

        Raises:
            FrameError: The stamp is not later than the last stamp of the stream.
        """
        if self.stamps_ns and half.stamp_ns <= self.stamps_ns[-1]:
            raise FrameError(
                f"the stamp {half.stamp_ns} ns must be later than the last stamp of the stream, "
                f"{self.stamps_ns[-1]} ns. Send images in the order of their exposure; if the "
                "camera's clock was set back, run `ldo control reset`."
            )
        self.stamps_ns.append(half.stamp_ns)
        self.waiting.append(half)

    def lose(self) -> None:
        """Drop and count the oldest measurement."""
        self.waiting.popleft()
        self.lost += 1

    def period_ns(self) -> int | None:
        """Return the smallest recent interval between stamps, or None before the second stamp."""
        return min((b - a for a, b in pairwise(self.stamps_ns)), default=None)


class StreamPairer(Generic[A, B]):
    """Pairing of the measurements of two live streams by nearest stamp.

    The stamps of a pair differ by at most `max_skew_ns`. Pairs keep the order of both streams, and
    each measurement is used at most once.

    The pairer compares the oldest waiting measurements of the two streams. It looks at the stream
    whose measurement is the earlier one. The next measurement of this stream comes one period
    later. If the two stamps differ by at most half a period, the next measurement cannot be nearer,
    so the pairer returns the pair immediately. Otherwise it waits for the next measurement. While
    the period is unknown, any difference up to `max_skew_ns` is accepted.

    At most `buffer` measurements of a stream wait. If there are more, the oldest one is paired with
    the best available partner or dropped. Equal input gives equal pairs, because no clock is read.

    Args:
        max_skew_ns: Largest difference between the stamps of a pair, nanoseconds.
        buffer: Largest number of measurements of a stream that wait for a partner.
        size_of: Function that returns the size of a measurement in bytes.
        max_bytes: Largest total size in bytes of the waiting measurements of both streams. Beyond
            it, the oldest measurement of the larger stream is dropped. A single measurement may
            wait whatever its size.

    Raises:
        ConfigError: An argument is out of range.
    """

    def __init__(
        self,
        max_skew_ns: int,
        buffer: int,
        size_of: Callable[[Any], int] = lambda _half: 0,
        max_bytes: int = 0,
    ) -> None:
        if max_skew_ns < 0 or buffer < 1:
            raise ConfigError(
                f"max_skew_ns={max_skew_ns} must be at least 0 and buffer={buffer} at least 1."
            )
        self._max_skew_ns, self._buffer = max_skew_ns, buffer
        self._size_of, self._max_bytes = size_of, max_bytes
        self._a, self._b = StreamBuffer(), StreamBuffer()
        self._skews_ns: deque[int] = deque(maxlen=RECENT_PAIRS)
        self.pairs = 0

    def add_a(self, half: A) -> Iterator[tuple[A, B]]:
        """Add a measurement of the first stream, and return the pairs that it completes.

        Raises:
            FrameError: The stamp is not later than the last stamp of the stream.
        """
        self._a.add(half)
        return self._decided()

    def add_b(self, half: B) -> Iterator[tuple[A, B]]:
        """Add a measurement of the second stream, and return the pairs that it completes.

        Raises:
            FrameError: The stamp is not later than the last stamp of the stream.
        """
        self._b.add(half)
        return self._decided()

    @property
    def lost_a(self) -> int:
        """Number of measurements of the first stream that were dropped without a partner."""
        return self._a.lost

    @property
    def lost_b(self) -> int:
        """Number of measurements of the second stream that were dropped without a partner."""
        return self._b.lost

    @property
    def waiting_bytes(self) -> int:
        """Size of the measurements of both streams that wait for a partner, bytes."""
        return self._bytes_of(self._a) + self._bytes_of(self._b)

    def skews_ms(self) -> list[float]:
        """Return the absolute stamp differences of the last 200 pairs, in milliseconds."""
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
                break
            else:
                self.pairs += 1
                self._skews_ns.append(skew)
                yield a.popleft(), b.popleft()  # type: ignore[misc]
        for half in (self._a, self._b):
            while len(half.waiting) > self._buffer:
                half.lose()
        while len(a) + len(b) > 1 and self.waiting_bytes > self._max_bytes:
            max(self._a, self._b, key=self._bytes_of).lose()

    def _bytes_of(self, stream: StreamBuffer) -> int:
        return sum(map(self._size_of, list(stream.waiting)))

    @staticmethod
    def _has_nearer(earlier: StreamBuffer, later: StreamBuffer, skew: int) -> bool:
        """Return whether the second waiting half of a stream makes a better pair than its first.

        A half is a measurement that waits for its partner in the other stream.

        Args:
            earlier: Stream whose oldest half is earlier.
            later: The other stream; its oldest half is the partner.
            skew: Difference between the stamps of the two oldest halves, nanoseconds.
        """
        target = later.waiting[0].stamp_ns
        return len(earlier.waiting) > 1 and abs(earlier.waiting[1].stamp_ns - target) < skew

    @staticmethod
    def _may_get_nearer(earlier: StreamBuffer, skew: int) -> bool:
        """Return whether the next measurement of a stream may be nearer than its oldest one.

        Nearer means a smaller difference between its stamp and that of the other stream's oldest
        measurement.

        Args:
            earlier: Stream whose oldest waiting measurement is earlier.
            skew: Difference between the stamps of the two oldest measurements, nanoseconds.
        """
        period = earlier.period_ns()
        return len(earlier.waiting) == 1 and period is not None and 2 * skew > period
