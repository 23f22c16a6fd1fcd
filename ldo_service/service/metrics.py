"""HTTP server with the health of all actors: `ldo serve --metrics-port PORT`.

It listens on loopback by default.

- `/metrics`: Metrics of the health messages for Prometheus. Counters restart from 0 with the
  process of their actor, as Prometheus expects. A silent actor keeps only its counters and the age
  of its last heartbeat.
- `/healthz`: 200 while every actor sends heartbeats, else 503 with the names of the silent actors.
  The reply describes only the current state.
- `/readyz`: 200 while no actor is silent and no actor fails on every message, else 503 with the
  names of these actors. A restart of the service does not help an actor that fails. The reply
  also warns, without another status, of a certificate that expires within 30 days.
"""

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from socketserver import ThreadingMixIn
from threading import Lock, Thread
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

import msgspec
from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ldo_service.errors import ConfigError, UnavailableError
from ldo_service.schemas import Health, InputCount, OutputCount, decode
from ldo_service.transport.endpoint import LOOPBACK
from ldo_service.transport.keys import expiry_warning

MAX_ACTORS = 64  # Limit of the stored names, because messages may contain any name.
COMES_BACK_S = 5.0  # Time for an actor to restart after it was killed at its heartbeat timeout.

MAX_CONNECTIONS = 16  # Maximum connections of the metrics server; usually two are in use.
REQUEST_TIMEOUT_S = 5.0  # Maximum time without data from a client of the metrics server.

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
        self._robot, self._actors = robot, tuple(actors)
        self._silent_after_s = silent_after_s + COMES_BACK_S
        self._lock = Lock()
        self._last: dict[str, tuple[float, Health]] = {}  # Arrival and heartbeat, by actor.
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
            self._last[health.actor] = (time.monotonic(), health)

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
        """Return the names of the actors that failed on each of their last messages."""
        with self._lock:
            return sorted(actor for actor, (_, health) in self._last.items() if health.failing)

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


class _Server(ThreadingMixIn, WSGIServer):
    """HTTP server with a thread per connection and a maximum number of connections.

    Beyond this number it closes the oldest connection. Idle connections therefore cannot block a
    new one, and cannot use up the file descriptors that saving the state needs.
    """

    daemon_threads = True
    _open: deque[socket.socket]
    _open_lock: Lock

    def server_activate(self) -> None:
        self._open, self._open_lock = deque(), Lock()
        super().server_activate()

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._open_lock:
            self._open.append(request)
            oldest = self._open.popleft() if len(self._open) > MAX_CONNECTIONS else None
        if oldest is not None:
            with suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)  # The thread of the connection then closes it.
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._open_lock, suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore an error of a connection, because its client has caused the error."""


class _Quiet(WSGIRequestHandler):
    timeout = REQUEST_TIMEOUT_S

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log line of each request."""


@contextmanager
def serve_metrics(collector: HealthCollector, port: int, address: str = LOOPBACK) -> Iterator[None]:
    """Serve http://ADDRESS:PORT/metrics, /healthz and /readyz inside the block.

    Raises:
        ConfigError: The port is no port number.
        UnavailableError: The server cannot listen on the address and port.
    """
    if not 0 < port < 65536:
        raise ConfigError(f"--metrics-port {port} must be within 1..65535.")
    registry = CollectorRegistry()
    registry.register(collector)
    metrics = make_wsgi_app(registry)

    def answer(environ: Any, start_response: Any) -> Iterable[bytes]:
        if environ["PATH_INFO"] == "/healthz":
            return _how_it_is(collector.silent_actors(), [], start_response)
        if environ["PATH_INFO"] == "/readyz":
            silent, failing = collector.silent_actors(), collector.failing_actors()
            expiry = expiry_warning(collector.certificate_until_s)
            return _how_it_is(silent, failing, start_response, expiry)
        return metrics(environ, start_response)

    try:
        family = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0][0]
        kind = type("Server", (_Server,), {"address_family": family})
        server = make_server(address, port, answer, kind, _Quiet)
    except OSError as error:
        raise UnavailableError(
            f"--metrics-port {port}: cannot listen on {address}:{port} ({error.strerror}). "
            "Choose another port, or another address with service.metrics_address."
        ) from error
    thread = Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _how_it_is(
    silent: list[str], failing: list[str], start_response: Any, expiry: str = ""
) -> list[bytes]:
    status = "503 Service Unavailable" if silent or failing else "200 OK"
    start_response(status, [("Content-Type", "text/plain; charset=utf-8")])
    problems = [f"no heartbeat: {', '.join(silent)}"] if silent else []
    problems += [f"failing on every message: {', '.join(failing)}"] if failing else []
    state = "; ".join(problems) or "every actor reports"
    warning = f"; the certificate of the service {expiry}" if expiry else ""
    return [f"{state}{warning}\n".encode()]
