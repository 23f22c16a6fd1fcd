"""HTTP server with the health of all actors: `ldo serve --metrics-port PORT`.

The server listens on loopback by default.

- `/metrics`: Metrics of the health messages for Prometheus. Counters of an actor restart from 0
  when its process restarts, as Prometheus expects. An actor without recent heartbeats has only its
  counters and the age of its last heartbeat.
- `/healthz`: Status 200 while every actor sends heartbeats, else 503 with the names of the actors
  without recent heartbeats. The reply describes only the current state.
- `/readyz`: Status 200 while every actor sends heartbeats, no actor fails on every message, and
  each actor with queued messages handles them (`find_stall` of diagnostics.py), else 503 with the
  names of the other actors. A restart does not help an actor that fails.
- `/readyz` also says, with unchanged status, that an actor is paused, that the certificate expires
  within 30 days, or that the older copy of the actors' states (generation) is more than a minute
  out of date.
"""

import socket
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from socketserver import ThreadingMixIn
from threading import Lock, Thread
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app

from ldo_service.errors import ConfigError, UnavailableError
from ldo_service.transport.endpoint import LOOPBACK

from .metrics import HealthCollector

MAX_CONNECTIONS = 16  # Maximum connections of the metrics server; usually two are in use.
REQUEST_TIMEOUT_S = 5.0  # Maximum time without data from a client of the metrics server.
STOP_INTERVAL_S = 0.1  # Interval at which the server looks whether it must stop.


class _Server(ThreadingMixIn, WSGIServer):
    """HTTP server with a thread per connection and a maximum number of connections.

    Beyond this number it closes the oldest connection. Idle connections therefore cannot block a
    new one, and cannot use up the file descriptors that saving the state needs.
    """

    daemon_threads = True
    # Linux drops a connection beyond this number, and the client tries again after a second.
    request_queue_size = 4 * MAX_CONNECTIONS
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
        ConfigError: The port is not within 1..65535.
        UnavailableError: The server cannot listen on the address and port.
    """
    if not 0 < port < 65536:
        raise ConfigError(f"--metrics-port {port} must be within 1..65535.")
    registry = CollectorRegistry()
    registry.register(collector)
    metrics = make_wsgi_app(registry)

    def answer(environ: Any, start_response: Any) -> Iterable[bytes]:
        if environ["PATH_INFO"] == "/healthz":
            return _how_it_is(_silence(collector), start_response)
        if environ["PATH_INFO"] == "/readyz":
            failing = collector.failing_actors()
            problems = _silence(collector)
            problems += [f"failing on every message: {', '.join(failing)}"] if failing else []
            problems += collector.stalls()
            return _how_it_is(problems, start_response, collector.warnings())
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
    thread = Thread(
        target=server.serve_forever, args=(STOP_INTERVAL_S,), name="metrics", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _silence(collector: HealthCollector) -> list[str]:
    silent = collector.silent_actors()
    return [f"no heartbeat: {', '.join(silent)}"] if silent else []


def _how_it_is(
    problems: list[str], start_response: Any, warnings: Iterable[str] = ()
) -> list[bytes]:
    status = "503 Service Unavailable" if problems else "200 OK"
    start_response(status, [("Content-Type", "text/plain; charset=utf-8")])
    state = "; ".join(problems) or "every actor reports"
    return [f"{'; '.join([state, *warnings])}\n".encode()]
