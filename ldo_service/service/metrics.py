"""Metrics of the health of all actors, for Prometheus.

Counters of an actor restart from 0 when its process restarts, as Prometheus expects. An actor
without recent heartbeats has only its counters and the age of its last heartbeat.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from math import inf
from threading import Lock
from typing import Any

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ldo_service.schemas import Health, InputCount, OutputCount, decode
from ldo_service.transport.keys import expiry_warning

from .diagnostics import IDLE_S, PAUSED, count_queued, find_stall

MAX_ACTORS = 64  # Limit of the stored names, because messages may contain any name.
COMES_BACK_S = 5.0  # Time for an actor to restart after it was killed at its heartbeat timeout.

# Age in seconds of the last generation of the states, the copy to which the service falls
# back, above which `HealthCollector.warnings` reports it.
OLD_GENERATION_S = 60.0

Row = tuple[type[CounterMetricFamily] | type[GaugeMetricFamily], str, str]

OF_ACTOR: dict[Row, Callable[[Health], float]] = {
    (CounterMetricFamily, "steps", "Messages handled by the actor."): lambda h: h.steps,
    (
        CounterMetricFamily,
        "failures",
        "Exceptions in handlers, restores and final messages; failed saves in a row count once.",
    ): lambda h: h.failures,
    (CounterMetricFamily, "restarts", "Restarts of the actor within its process."): lambda h: (
        h.restarts
    ),
    (
        CounterMetricFamily,
        "dead_letters",
        "Messages that the actor discarded because their handling failed twice.",
    ): lambda h: h.dead_lettered,
    (
        CounterMetricFamily,
        "quarantined",
        "Messages that ended the process of the actor repeatedly.",
    ): lambda h: h.quarantined,
    (
        GaugeMetricFamily,
        "failing",
        "1 if the actor failed on each of its last messages.",
    ): lambda h: h.failing,
    (GaugeMetricFamily, "step_age_seconds", "Time since the last step ended."): lambda h: (
        h.step_age_s
    ),
    (GaugeMetricFamily, "current_step_seconds", "Time since the current step began."): lambda h: (
        h.current_step_s
    ),
    (GaugeMetricFamily, "resident_bytes", "Resident memory of the process."): lambda h: (
        h.rss_mb * 1e6
    ),
    (GaugeMetricFamily, "paused", "1 while the actor is paused."): lambda h: h.paused,
}
OF_INPUT: dict[Row, Callable[[InputCount], float]] = {
    (
        CounterMetricFamily,
        "input_messages",
        "Messages of the topic that the actor has handled.",
    ): lambda i: i.delivered,
    (
        CounterMetricFamily,
        "input_dropped",
        "Messages dropped because newer messages replaced them.",
    ): lambda i: i.dropped,
    (
        CounterMetricFamily,
        "input_rejected",
        "Messages rejected as invalid or too large.",
    ): lambda i: i.rejected,
    (CounterMetricFamily, "input_dropped_paused", "Messages dropped while paused."): lambda i: (
        i.dropped_paused
    ),
    (CounterMetricFamily, "input_lost", "Messages that never arrived."): lambda i: i.lost,
    (CounterMetricFamily, "input_gaps", "Messages that arrived out of order."): lambda i: i.gaps,
    (GaugeMetricFamily, "input_queued", "Messages in the mailbox now."): lambda i: i.queued,
}
OF_OUTPUT: dict[Row, Callable[[OutputCount], float]] = {
    (CounterMetricFamily, "output_messages", "Sent messages of the topic."): lambda o: o.sent,
    (
        CounterMetricFamily,
        "output_backpressure_waits",
        "Times that the actor waited until a slow consumer took a message.",
    ): lambda o: o.backpressure_waits,
    (
        CounterMetricFamily,
        "output_evicted",
        "Consumers evicted because they took no message for too long.",
    ): lambda o: o.evicted_consumers,
    (
        CounterMetricFamily,
        "output_retransmitted",
        "Messages sent again because a consumer had not received them.",
    ): lambda o: o.retransmitted,
    (
        GaugeMetricFamily,
        "output_backlog_messages",
        "Messages that the slowest consumer with a backlog has not handled.",
    ): lambda o: max(o.behind.values(), default=0),
    (GaugeMetricFamily, "output_backlog_mb", "Size of the stored backlog, MB."): lambda o: (
        o.backlog_mb
    ),
    (
        CounterMetricFamily,
        "output_backlog_dropped",
        "Messages dropped because the backlog was full.",
    ): lambda o: o.backlog_dropped,
}


class HealthCollector(Collector):
    """Prometheus collector that reads the last heartbeat of each actor of a robot."""

    def __init__(
        self,
        robot: str,
        actors: Iterable[str] = (),
        silent_after_s: float = 10.0,
        certificate_until_s: float | None = None,
    ) -> None:
        """Initialize without heartbeats.

        Args:
            robot: Name of the robot, a label of every metric.
            actors: Names of the actors that must send heartbeats.
            silent_after_s: Heartbeat timeout of the service, seconds.
            certificate_until_s: End of the validity of the service's certificate, Unix time in
                seconds; None without keys.
        """
        self.certificate_until_s = certificate_until_s
        # Function that returns the age of the last generation of the states, seconds; None if the
        # service keeps none.
        self.generation_age_s: Callable[[], float] | None = None
        self._robot, self._actors = robot, tuple(actors)
        self._silent_after_s = silent_after_s + COMES_BACK_S
        self._lock = Lock()
        self._last: dict[str, tuple[float, Health]] = {}  # Arrival and heartbeat, by actor.
        # Time since which each actor has had queued messages and handled none, by actor. If none
        # was queued, or the actor has handled one since, it is the time of the last heartbeat.
        self._queued_since_s: dict[str, float] = {}
        self._begun_anew: dict[str, int] = {}  # Number of process restarts, by actor.

    def on_health(self, _header: bytes, body: memoryview) -> None:
        """Store a heartbeat, on any thread; malformed messages are ignored."""
        try:
            health = decode(body, Health)
        except msgspec.DecodeError:
            return
        with self._lock:
            if health.actor not in self._last and len(self._last) >= MAX_ACTORS:
                return
            _, before = self._last.get(health.actor, (0.0, health))
            self._begun_anew.setdefault(health.actor, 0)
            self._begun_anew[health.actor] += health.pid != before.pid
            now_s = time.monotonic()
            if not self._has_waited(health, now_s):
                self._queued_since_s[health.actor] = now_s
            self._last[health.actor] = (now_s, health)

    def _has_waited(self, health: Health, now_s: float) -> bool:
        """Return whether messages have been queued since the last heartbeat and none was handled.

        The result is False after a time without heartbeats, in which this process or that of the
        actor may have been suspended.
        """
        before_s, before = self._last.get(health.actor, (-inf, health))
        return (
            now_s - before_s <= IDLE_S
            and not before.paused
            and count_queued(before) > 0
            and _progress(before) == _progress(health)
        )

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics, as Prometheus requires."""
        with self._lock:
            last, anew = dict(sorted(self._last.items())), dict(sorted(self._begun_anew.items()))
        since_s = time.monotonic() - self._silent_after_s
        known = [health for _, health in last.values()]
        now = [health for at_s, health in last.values() if at_s > since_s]
        for metric in (
            self._ages(last),
            self._certificate(),
            self._generation(),
            _processes(anew),
            _step_seconds(now),
            _facts(now),
            *_table(OF_ACTOR, ["actor"], known, now, lambda h: [([h.actor], h)]),
            *_table(
                *(OF_INPUT, ["actor", "topic"], known, now),
                lambda h: [([h.actor, i.topic], i) for i in h.inputs],
            ),
            *_table(
                *(OF_OUTPUT, ["actor", "topic"], known, now),
                lambda h: [([h.actor, o.topic], o) for o in h.outputs],
            ),
        ):
            for sample in metric.samples:
                sample.labels["robot"] = self._robot
            yield metric

    def silent_actors(self) -> list[str]:
        """Return the names of the actors without a recent heartbeat.

        Before the first heartbeat, these are all actors of the service.
        """
        since_s = time.monotonic() - self._silent_after_s
        with self._lock:
            heard = {actor for actor, (at_s, _) in self._last.items() if at_s > since_s}
        return sorted({*self._actors} - heard)

    def failing_actors(self) -> list[str]:
        """Return the names of the actors that failed on each of their last three messages."""
        with self._lock:
            return sorted(actor for actor, (_, health) in self._last.items() if health.failing)

    def stalls(self) -> list[str]:
        """Return a sentence per actor that has queued messages and makes no progress.

        The rule is that of `ldo doctor`. Its step age is too old after a pause of the camera: the
        first message is then queued or being saved while the last step ended long ago. Messages
        must therefore have been queued for the same time too.
        """
        found = []
        for health, queued_s in self._current():
            age_s = min(health.step_age_s, queued_s)
            stall = find_stall(msgspec.structs.replace(health, step_age_s=age_s))
            if stall and count_queued(health):
                found.append(f"{health.actor} {stall}")
        return found

    def _current(self) -> list[tuple[Health, float]]:
        """Return the last heartbeat of each actor with a recent heartbeat, sorted by name.

        The second value is the time in seconds for which the actor had handled none of its queued
        messages when it sent the heartbeat.
        """
        since_s = time.monotonic() - self._silent_after_s
        with self._lock:
            return [
                (health, at_s - self._queued_since_s[actor])
                for actor, (at_s, health) in sorted(self._last.items())
                if at_s > since_s
            ]

    @staticmethod
    def _ages(last: dict[str, tuple[float, Health]]) -> Metric:
        ages = GaugeMetricFamily(
            "ldo_heartbeat_age_seconds", "Time since the last heartbeat.", labels=["actor"]
        )
        for actor, (heard_at_s, _) in last.items():
            ages.add_metric([actor], time.monotonic() - heard_at_s)
        return ages

    def _certificate(self) -> Metric:
        expiry = GaugeMetricFamily(
            "ldo_certificate_expiry_seconds",
            "Time until the certificate of the service expires, negative after that; absent "
            "without keys.",
            labels=[],
        )
        if self.certificate_until_s is not None:
            expiry.add_metric([], self.certificate_until_s - time.time())
        return expiry

    def _generation(self) -> Metric:
        age = GaugeMetricFamily(
            "ldo_generation_age_seconds",
            "Time since the older generation of the states, to which the service falls back, was "
            "up to date; absent without --state.",
            labels=[],
        )
        if self.generation_age_s is not None:
            age.add_metric([], self.generation_age_s())
        return age

    def warnings(self) -> Iterator[str]:
        """Yield a sentence per fact that the user should know although the service is ready."""
        for health, _ in self._current():
            if health.paused:
                yield f"{health.actor} {PAUSED}"
        if expiry := expiry_warning(self.certificate_until_s):
            yield f"the certificate of the service {expiry}"
        age_s = self.generation_age_s() if self.generation_age_s else 0.0
        if age_s > OLD_GENERATION_S:
            yield (
                "the generation of the states to which the service falls back is out of date for "
                f"{age_s:.0f} s, and a power cut could lose the keyframes of this time"
            )


def _progress(health: Health) -> tuple[int, ...]:
    """Return numbers that change if an actor handles or discards a message, or starts again."""
    return health.pid, health.epoch, health.steps, health.dead_lettered, health.quarantined


def _table(
    rows: dict[Row, Callable],
    labels: list[str],
    known: list[Health],
    now: list[Health],
    items_of: Callable[[Health], list[tuple[list[str], Any]]],
) -> Iterator[Metric]:
    """Yield the metrics of a table.

    Args:
        rows: Type, name and help text of each metric, with the function that reads its value.
        labels: Names of the labels.
        known: Health of all known actors, for counters.
        now: Health of the actors with a recent heartbeat, for gauges.
        items_of: Function from a health message to pairs: label values, and the item from which
            the functions of `rows` read.
    """
    for (family, name, help_text), value in rows.items():
        metric = family(f"ldo_{name}", help_text, labels=labels)
        for health in known if family is CounterMetricFamily else now:
            for of_labels, item in items_of(health):
                metric.add_metric(of_labels, float(value(item)))
        yield metric


def _processes(begun_anew: dict[str, int]) -> Metric:
    help_text = "Restarts of the actor's process since this exporter started."
    metric = CounterMetricFamily("ldo_process_restarts", help_text, labels=["actor"])
    for actor, count in begun_anew.items():
        metric.add_metric([actor], count)
    return metric


def _step_seconds(actors: list[Health]) -> Metric:
    metric = GaugeMetricFamily(
        "ldo_step_seconds",
        "Quantiles of the handling times of the last 200 messages.",
        labels=["actor", "quantile"],
    )
    for health in actors:
        metric.add_metric([health.actor, "0.5"], health.step_ms_p50 * 1e-3)
        metric.add_metric([health.actor, "0.95"], health.step_ms_p95 * 1e-3)
    return metric


def _facts(actors: list[Health]) -> Metric:
    metric = GaugeMetricFamily(
        "ldo_actor_metric",
        "Value of the actor's own metric that the label `metric` names.",
        labels=["actor", "metric"],
    )
    for health in actors:
        for name, value in health.metrics.items():
            metric.add_metric([health.actor, name], value)
    return metric
