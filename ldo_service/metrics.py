"""`ldo serve --metrics PORT`: the actors' health messages for Prometheus, by default on loopback.

Counters restart from 0 with their actor's process, as Prometheus expects of counters.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import Lock

import msgspec
from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ldo_service.errors import ConfigError
from ldo_service.schemas import Health, InputCount, OutputCount, decode

LOOPBACK = "127.0.0.1"  # anyone who may read them may also see where the robot is at work
MOST_ACTORS = 64  # that are kept; a name is what a message says

Row = tuple[type[CounterMetricFamily] | type[GaugeMetricFamily], str, str]

OF_ACTOR: dict[Row, Callable[[Health], float]] = {
    (CounterMetricFamily, "steps", "messages handled"): lambda h: h.steps,
    (CounterMetricFamily, "failures", "exceptions in the handler"): lambda h: h.failures,
    (CounterMetricFamily, "restarts", "times the actor was rebuilt"): lambda h: h.restarts,
    (CounterMetricFamily, "set_aside", "messages that failed twice"): lambda h: h.set_aside,
    (GaugeMetricFamily, "step_age_seconds", "since the last step ended"): lambda h: h.step_age_s,
    (GaugeMetricFamily, "busy_seconds", "age of the step under way"): lambda h: h.busy_s,
    (GaugeMetricFamily, "resident_bytes", "memory of its process"): lambda h: h.rss_mb * 1e6,
    (GaugeMetricFamily, "held", "1: takes nothing, on request"): lambda h: h.held,
}
OF_INPUT: dict[Row, Callable[[InputCount], float]] = {
    (CounterMetricFamily, "input_delivered", "handled by the actor"): lambda i: i.delivered,
    (CounterMetricFamily, "input_dropped", "displaced by newer ones"): lambda i: i.dropped,
    (CounterMetricFamily, "input_rejected", "no valid message"): lambda i: i.rejected,
    (CounterMetricFamily, "input_paused", "left out while paused"): lambda i: i.paused,
    (CounterMetricFamily, "input_lost", "never came, by number"): lambda i: i.lost,
    (CounterMetricFamily, "input_gaps", "came out of order"): lambda i: i.gaps,
    (GaugeMetricFamily, "input_waiting", "in the mailbox now"): lambda i: i.waiting,
}
OF_OUTPUT: dict[Row, Callable[[OutputCount], float]] = {
    (CounterMetricFamily, "output_sent", "messages sent"): lambda o: o.sent,
    (CounterMetricFamily, "output_waited", "times it waited for room"): lambda o: o.waited,
    (CounterMetricFamily, "output_evicted", "consumers given up"): lambda o: o.evicted,
    (CounterMetricFamily, "output_repeated", "sent again after a loss"): lambda o: o.repeated,
}


class HealthCollector(Collector):
    """Keeps the last heartbeat of each actor; decoded when somebody asks."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._last: dict[str, tuple[float, Health]] = {}  # by actor: when it was heard

    def heard(self, _header: bytes, body: memoryview) -> None:
        """On any thread; bytes that are no health message are left alone."""
        try:
            health = decode(body, Health)
        except msgspec.DecodeError:
            return
        with self._lock:
            if health.actor in self._last or len(self._last) < MOST_ACTORS:
                self._last[health.actor] = (time.monotonic(), health)

    def collect(self) -> Iterator[Metric]:
        with self._lock:
            last = dict(sorted(self._last.items()))
        actors = [health for _, health in last.values()]
        yield self._ages(last)
        yield _step_seconds(actors)
        yield _facts(actors)
        yield from _table(OF_ACTOR, ["actor"], (([h.actor], h) for h in actors))
        yield from _table(
            OF_INPUT,
            ["actor", "topic"],
            (([h.actor, i.topic], i) for h in actors for i in h.inputs),
        )
        yield from _table(
            OF_OUTPUT,
            ["actor", "topic"],
            (([h.actor, o.topic], o) for h in actors for o in h.outputs),
        )

    @staticmethod
    def _ages(last: dict[str, tuple[float, Health]]) -> Metric:
        ages = GaugeMetricFamily(
            "ldo_heartbeat_age_seconds", "since it was heard", labels=["actor"]
        )
        for actor, (heard_at_s, _) in last.items():
            ages.add_metric([actor], time.monotonic() - heard_at_s)
        return ages


def _table(rows: dict[Row, Callable], labels: list[str], items: Iterable) -> Iterator[Metric]:
    items = list(items)
    for (family, name, says), value in rows.items():
        metric = family(f"ldo_{name}", says, labels=labels)
        for of_labels, item in items:
            metric.add_metric(of_labels, float(value(item)))
        yield metric


def _step_seconds(actors: list[Health]) -> Metric:
    metric = GaugeMetricFamily(
        "ldo_step_seconds", "time of the last 200 steps", labels=["actor", "quantile"]
    )
    for health in actors:
        metric.add_metric([health.actor, "0.5"], health.step_ms_p50 * 1e-3)
        metric.add_metric([health.actor, "0.95"], health.step_ms_p95 * 1e-3)
    return metric


def _facts(actors: list[Health]) -> Metric:
    metric = GaugeMetricFamily("ldo_fact", "what the actor counts itself", labels=["actor", "fact"])
    for health in actors:
        for name, value in health.facts.items():
            metric.add_metric([health.actor, name], value)
    return metric


@contextmanager
def exported(collector: HealthCollector, port: int, address: str = LOOPBACK) -> Iterator[None]:
    """Serve http://ADDRESS:PORT/metrics inside the block.

    Raises ConfigError when the port or the address cannot be had.
    """
    if not 0 < port < 65536:
        raise ConfigError(f"--metrics {port}: a port is a number in 1..65535.")
    registry = CollectorRegistry()
    registry.register(collector)
    try:
        server, thread = start_http_server(port, address, registry)
    except OSError as error:
        raise ConfigError(
            f"--metrics {port}: cannot listen on {address}:{port} ({error.strerror}). Is another "
            "service exporting there? Choose another port, or service.metrics_address."
        ) from error
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
