"""Forecast for a service: resources per keyframe, and the limits that the service reaches first.

A forecast continues the trend of some heartbeats, or of the files in a state folder. The forecast
is valid only while the camera moves as during the time of these heartbeats or files.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.special import stdtrit

from ldo_service.schemas import Health, OutputCount

# Bounds later than this are not reported, seconds. A trend of some seconds says nothing about the
# day after.
HORIZON_S = 24 * 3600.0
# Minimum number of values for a trend: two points always lie on a line, so that
# they do not show how much the values scatter.
MIN_VALUES = 3
# Confidence that a trend is no scatter. A service has about ten processes and as many sizes on
# disk, so that a confidence of 95 % would report growth of a constant service most of the time.
CONFIDENCE = 0.99
# Fraction of a limit from which a bound counts as reached. A store that deletes its oldest entries
# stays just below its limit.
REACHED = 0.99

IMAGES_DELETED = "images of redundant keyframes are then deleted"
KEYFRAME_IMAGES = "keyframe images on disk"
STORED_KEYFRAMES = "keyframes with images"
_OF_MAPPER = (  # Metric, metric of its limit, bound, unit and consequence.
    (
        *("gaussians", "gaussians_max"),
        *("Gaussians in memory", "", "Gaussians out of view are then offloaded to disk"),
    ),
    ("keyframes_disk_mb", "keyframes_disk_max_mb", KEYFRAME_IMAGES, " MB", IMAGES_DELETED),
    ("keyframes_stored", "keyframes_stored_max", STORED_KEYFRAMES, "", IMAGES_DELETED),
)
# Metrics with the sizes of an actor's files in the state folder.
_STATE_FILES = ("state_mb", "keyframes_disk_mb", "gaussians_disk_mb")
RECORDING_ENDS = "the recording then ends"
DISK_FULL = "nothing can be saved then, and the map no longer grows"
MEMORY_FULL = "the operating system may then kill a process of the service"


@dataclass(frozen=True, slots=True)
class Trend:
    """Line that is fitted to the values of one quantity over time."""

    value: float  # Last value.
    per_s: float  # Slope per second; 0 if it may be scatter, or the effect of a single step.

    @staticmethod
    def of(times_s: Sequence[float], values: Sequence[float]) -> "Trend":
        """Fit a line by least squares.

        A single jump of the values, for example after a state was saved, is no trend. If one jump
        is more than half of the total change, parallel lines are fitted: one line to the values
        before the jump, and one to the values after the jump.

        Args:
            times_s: Times of the values, seconds.
            values: The values, as many as there are times, and at least one.
        """
        t, v = np.array(times_s, float), np.array(values, float)
        if len(t) < MIN_VALUES:
            return Trend(float(v[-1]), 0.0)
        slope = _clear_slope([t], [v])
        steps = np.diff(v)
        largest = int(np.argmax(np.abs(steps)))
        if 2 * abs(steps[largest]) > abs(v[-1] - v[0]):
            parts = np.split(t, [largest + 1]), np.split(v, [largest + 1])
            slope_of_parts = _clear_slope(*parts)
            slope = slope_of_parts if slope * slope_of_parts > 0 else 0.0
        return Trend(float(v[-1]), slope)


def _clear_slope(times_s: Sequence[np.ndarray], values: Sequence[np.ndarray]) -> float:
    """Return the slope of parallel lines; 0 if it is not significant by Student's t-test.

    Args:
        times_s: Times of the values of each line, seconds.
        values: Values of each line.
    """
    t = np.concatenate([part - part.mean() for part in times_s])
    v = np.concatenate([part - part.mean() for part in values])
    spread, degrees = float(t @ t), len(t) - len(times_s) - 1
    if spread == 0 or degrees < 1:
        return 0.0
    slope = float(t @ v) / spread
    residuals = v - slope * t
    standard_error = (float(residuals @ residuals) / degrees / spread) ** 0.5
    return slope if abs(slope) > stdtrit(degrees, (1 + CONFIDENCE) / 2) * standard_error else 0.0


@dataclass(frozen=True, slots=True)
class Bound:
    """Limit of a resource that a service approaches, and the effect of reaching the limit."""

    what: str
    consequence: str  # Effect of reaching the bound.
    state: str  # Present distance to the bound, in words.
    left: float  # Remaining amount until the bound; 0 if it is reached.
    per_s: float  # Decrease of `left` per second; negative if it increases.

    @staticmethod
    def of(what: str, consequence: str, trend: Trend, limit: float, unit: str = "") -> "Bound":
        """Return the bound of a quantity whose upper limit is `limit`, a positive number."""
        state = f"{trend.value:,.0f} of {limit:,.0f}{unit}"
        left = 0.0 if trend.value >= REACHED * limit else limit - trend.value
        return Bound(what, consequence, state, left, trend.per_s)

    @property
    def time_s(self) -> float:
        """Seconds until the bound is reached: 0 if already reached, infinity if never reached."""
        if self.left <= 0:
            return 0.0
        return self.left / self.per_s if self.per_s > 0 else inf

    def __str__(self) -> str:
        when = f"in {duration(self.time_s)}" if self.time_s > 0 else "reached now"
        return f"{self.what}, {when} ({self.state}): {self.consequence}"


@dataclass(frozen=True, slots=True)
class Forecast:
    """Growth rates of a service, and the bounds that the service reaches at these rates."""

    basis: str  # Source of the rates, and its time window.
    keyframes_per_s: float = 0.0
    memory_mb_per_s: float | None = None  # Sum over all processes; None: unknown.
    disk_mb_per_s: float = 0.0  # Growth of the state folder and the recording.
    # Median duration of a step of the mapper, ms; None: unknown.
    keyframe_ms: float | None = None
    bounds: tuple[Bound, ...] = ()
    remarks: tuple[str, ...] = ()
    missing: str = ""  # Reason for the lack of rates; "" if there are rates.

    @property
    def reached(self) -> list[Bound]:
        """Bounds that are reached within 24 hours (`HORIZON_S`), the earliest first."""
        near = [bound for bound in self.bounds if bound.time_s <= HORIZON_S]
        return sorted(near, key=lambda bound: bound.time_s)

    def lines(self) -> Iterator[str]:
        """Yield the forecast as lines of text."""
        if self.missing:
            yield f"no forecast from {self.basis}: {self.missing}"
            yield from self.remarks
            return
        yield f"forecast, extrapolated from {self.basis}: {self._rates()}"
        yield from self.remarks
        bounds = self.reached
        if not bounds:
            yield "if this goes on, no limit is reached within 24 h"
        for bound in bounds:
            place = "if this goes on, the first limit is" if bound is bounds[0] else "after that,"
            yield f"{place} {bound}"

    def _rates(self) -> str:
        is_mapping = self.keyframes_per_s > 0
        per_s = 1 / self.keyframes_per_s if is_mapping else 60.0
        taken = [_change(self.memory_mb_per_s, per_s, "memory")]
        taken.append(_change(self.disk_mb_per_s, per_s, "disk"))
        if is_mapping and self.keyframe_ms is not None:
            taken.append(f"{self.keyframe_ms:.0f} ms of the mapper")
        start = (
            f"a keyframe every {per_s:.2g} s takes"
            if is_mapping
            else "no clear rate of keyframes (a longer window may show one); a minute takes"
        )
        return f"{start} {', '.join(taken)}"


def _change(mb_per_s: float | None, times_s: float, of: str) -> str:
    if mb_per_s is None:
        return f"an unknown amount of {of}"
    mb = round(mb_per_s * times_s, 2)
    return f"{mb:.2f} MB of {of}" if mb else f"no clear amount of {of}"


def duration(seconds: float) -> str:
    """Format a duration in hours if at least 1.5 h, in minutes if at least 1.5 min, else in s."""
    for unit_s, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * unit_s:
            return f"{seconds / unit_s:.1f} {unit}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True, slots=True)
class Heartbeats:
    """Heartbeats of one actor since its last restart."""

    times_s: tuple[float, ...]
    health: tuple[Health, ...]
    was_restarted: bool = False  # Heartbeats before a restart were left out.

    @staticmethod
    def of(series: Iterable[tuple[float, Health]]) -> "Heartbeats":
        """Select the heartbeats of an actor after its last restart.

        Args:
            series: All heartbeats of the actor, as pairs of arrival time in seconds and heartbeat.
        """
        kept: list[tuple[float, Health]] = []
        was_restarted = False
        for at_s, health in series:
            if kept and health == kept[-1][1]:
                continue  # The parent process repeats the last heartbeat of a busy child.
            if kept and _life(health) != _life(kept[-1][1]):
                kept, was_restarted = [], True
            kept.append((at_s, health))
        return Heartbeats(
            tuple(at_s for at_s, _ in kept), tuple(health for _, health in kept), was_restarted
        )

    @property
    def last(self) -> Health:
        return self.health[-1]

    @property
    def window_s(self) -> float:
        """Time from the first to the last heartbeat, seconds."""
        return self.times_s[-1] - self.times_s[0]

    @property
    def steps(self) -> int:
        """Number of messages handled between the first and the last heartbeat."""
        return self.last.steps - self.health[0].steps

    def metric(self, name: str) -> Trend | None:
        """Return the trend of a metric of the actor; None if no heartbeat has the metric."""
        known = [(t, h.metrics[name]) for t, h in zip(self.times_s, self.health, strict=True)
                 if name in h.metrics]  # fmt: skip
        return Trend.of(*zip(*known, strict=True)) if known else None

    def backlogs(self) -> Iterator[tuple[Trend, OutputCount]]:
        """Yield, for each output, the trend of its backlog size in MB, and its last counters."""
        for output in self.last.outputs:
            known = [
                (at_s, count.backlog_mb)
                for at_s, health in zip(self.times_s, self.health, strict=True)
                for count in health.outputs
                if count.topic == output.topic
            ]
            yield Trend.of(*zip(*known, strict=True)), output

    def memory(self) -> Trend:
        """Return the trend of the resident memory of the actor's process, MB."""
        return Trend.of(self.times_s, [health.rss_mb for health in self.health])


def _life(health: Health) -> tuple[int, int, int]:
    return health.pid, health.epoch, health.restarts


def forecast(series: Mapping[str, Sequence[tuple[float, Health]]]) -> Forecast:
    """Forecast the resources and bounds of a service from its heartbeats.

    Args:
        series: For each actor by name, pairs of arrival time in seconds and heartbeat, in order.
    """
    actors = {name: Heartbeats.of(beats) for name, beats in series.items() if beats}
    enough = {name: h for name, h in actors.items() if len(h.health) >= MIN_VALUES}
    basis = _basis(enough or actors)
    remarks = tuple(_remarks(actors))
    if not enough:
        missing = f"a trend needs {MIN_VALUES}; give a longer --window-s"
        return Forecast(basis, remarks=remarks, missing=missing)
    keyframes = _of_mapper(enough, "keyframes")
    memory_mb_per_s = _memory_growth(enough)
    mapper = enough.get("mapper")
    return Forecast(
        basis=basis,
        keyframes_per_s=keyframes.per_s if keyframes else 0.0,
        memory_mb_per_s=memory_mb_per_s,
        disk_mb_per_s=_state_growth(enough) + _recording_growth(enough),
        keyframe_ms=mapper.last.step_ms_p50 if mapper else None,
        bounds=(
            *_memory_bounds(enough, memory_mb_per_s),
            *_disk_bounds(enough),
            *_mapper_bounds(enough),
            *_recording_bounds(enough),
            *_backlog_bounds(enough),
        ),
        remarks=remarks,
    )


def _basis(actors: Mapping[str, Heartbeats]) -> str:
    if not actors:
        return "0 heartbeats"
    longest = max(actors.values(), key=lambda heartbeats: heartbeats.window_s)
    return f"{len(longest.health)} heartbeats of each actor over {longest.window_s:.1f} s"


def _remarks(actors: Mapping[str, Heartbeats]) -> Iterator[str]:
    for name, heartbeats in actors.items():
        if heartbeats.was_restarted:
            yield (
                f"{name} was restarted in this time; only its {len(heartbeats.health)} "
                "heartbeats since then count"
            )


def _of_mapper(actors: Mapping[str, Heartbeats], metric: str) -> Trend | None:
    return actors["mapper"].metric(metric) if "mapper" in actors else None


# --- memory and disk ------------------------------------------------------------------------------
def _memory_growth(actors: Mapping[str, Heartbeats]) -> float:
    """Return the growth of the resident memory of all processes, MB per second."""
    # Actors in one process report the same memory; the one with the longest trend counts.
    of_process: dict[int, Heartbeats] = {}
    for heartbeats in sorted(actors.values(), key=lambda heartbeats: heartbeats.window_s):
        of_process[heartbeats.last.pid] = heartbeats
    return sum(heartbeats.memory().per_s for heartbeats in of_process.values())


def _memory_bounds(actors: Mapping[str, Heartbeats], mb_per_s: float) -> Iterator[Bound]:
    left = [h.last.metrics["memory_available_mb"] for h in actors.values()
            if "memory_available_mb" in h.last.metrics]  # fmt: skip
    if left:  # Remote actors run on other machines: the one with the least memory counts.
        yield Bound("memory", MEMORY_FULL, f"{min(left):,.0f} MB available", min(left), mb_per_s)


def _state_growth(actors: Mapping[str, Heartbeats]) -> float:
    """Return the growth of all files in the state folder, MB per second."""
    trends = [h.metric(name) for h in actors.values() for name in _STATE_FILES]
    backlogs = [trend for h in actors.values() for trend, _ in h.backlogs()]
    return sum(trend.per_s for trend in (*trends, *backlogs) if trend)


def _recording_growth(actors: Mapping[str, Heartbeats]) -> float:
    """Return the growth of the recording, to which each actor writes a file, MB per second."""
    files = [h.metric("recording_file_mb") for h in actors.values()]
    return sum(file.per_s for file in files if file)


def _free_disk(
    actors: Mapping[str, Heartbeats], metric: str, own_mb_per_s: float
) -> tuple[Trend, str] | None:
    """Return the free space of a disk, its decrease, and both in words; None if unknown.

    Args:
        actors: Heartbeats of the actors, by name.
        metric: Metric of the free space.
        own_mb_per_s: Growth of the service's files on this disk.
    """
    # The actor with the most steps has measured the free space most often.
    for heartbeats in sorted(actors.values(), key=lambda heartbeats: -heartbeats.steps):
        if free := heartbeats.metric(metric):
            state = f"{free.value:,.0f} MB free"
            if -free.per_s > own_mb_per_s:
                state += f", {-free.per_s:.2g} MB less per second, for all programs together"
            return Trend(free.value, max(own_mb_per_s, -free.per_s)), state
    return None


def _disk_bounds(actors: Mapping[str, Heartbeats]) -> Iterator[Bound]:
    if found := _free_disk(actors, "disk_free_mb", _state_growth(actors)):
        free, state = found
        yield Bound("disk of the state folder", DISK_FULL, state, free.value, free.per_s)


# --- limits of stores -----------------------------------------------------------------------------
def _mapper_bounds(actors: Mapping[str, Heartbeats]) -> Iterator[Bound]:
    for name, of_limit, what, unit, consequence in _OF_MAPPER:
        value, limit = _of_mapper(actors, name), _of_mapper(actors, of_limit)
        if value is not None and limit is not None:
            yield Bound.of(what, consequence, value, limit.value, unit)


def _recording_bounds(actors: Mapping[str, Heartbeats]) -> Iterator[Bound]:
    def maximum(name: str) -> float:
        return max((h.last.metrics.get(name, 0.0) for h in actors.values()), default=0.0)

    size = Trend(maximum("recording_mb"), _recording_growth(actors))
    if limit_mb := maximum("recording_max_mb"):
        yield Bound.of("recording.max_gb", RECORDING_ENDS, size, limit_mb, " MB")
    if found := _free_disk(actors, "recording_free_mb", size.per_s):
        free, state = found
        left_mb = free.value - maximum("recording_min_free_mb")
        yield Bound("recording.min_free_gb", RECORDING_ENDS, state, left_mb, free.per_s)


def _backlog_bounds(actors: Mapping[str, Heartbeats]) -> Iterator[Bound]:
    for name, heartbeats in actors.items():
        for backlog, output in heartbeats.backlogs():
            # If no consumer is behind, the backlog only keeps messages for an older generation.
            slow = sorted(consumer for consumer, count in output.behind.items() if count)
            if output.backlog_max_mb > 0 and slow:
                yield Bound.of(
                    f"backlog of {output.topic} in {name}",
                    f"the oldest messages are then dropped and never reach {' and '.join(slow)}",
                    backlog,
                    output.backlog_max_mb,
                    " MB",
                )
