"""Transport over Zenoh, the network of the service.

Properties of zenoh-python 1.x that shape this module:

- Callbacks with `indirect=False` run on Zenoh's own thread, so they only store the message and
  notify the event loop. A plain `callback=` would add a hidden queue of 256 messages, and a thread
  that keeps the interpreter alive.
- `put` and `reply` may block, so they run in threads of this module.
- Everything is sent with congestion control DROP. With BLOCK, one stalled subscriber stalls the
  sender for seconds and then loses messages anyway. Flow control retransmits lost messages.
- By default, Zenoh listens on every interface and searches for peers. This module therefore listens
  only on the configured endpoint, and disables scouting, gossip and shared memory.
"""

import asyncio
import json
import logging
import os
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import replace
from threading import BoundedSemaphore, Lock
from typing import Any

import zenoh

from ldo_service.errors import ConfigError, UnavailableError

from .endpoint import CLOSED, DEFAULT_ENDPOINT, LOOPBACK, Endpoint
from .flow_control import ALIVE
from .interface import LastValues, OnMessage, OnPresence, call_soon
from .keys import TlsKeys
from .worker import Worker

log = logging.getLogger(__name__)

# Maximum number of pending queries for values, and of pending commands. Further queries or commands
# get an error.
MAX_QUERIES = 16
# Maximum number of programs at a router. Each takes a file descriptor; Zenoh's default is 1000.
MAX_SESSIONS = 256
CONNECT_WITHIN_MS = 3000
# Time without a message after which a program closes a connection, milliseconds. While packets are
# lost, TCP doubles the time to its next attempt, so a new connection continues sooner. With Zenoh's
# default of 10,000, results sometimes came only 20 s after a cut of the network. A lower value
# closes more connections if loss and delay are large (docs/benchmarks/faults.md).
LEASE_MS = 6000
# Maximum time between two attempts of a client to connect, milliseconds. Each attempt takes up to
# 10 s, and TCP sends nothing in its last 3 s. With Zenoh's default of 4000, a client therefore
# waited for up to 7 s after a long cut (docs/benchmarks/faults.md).
MAX_RETRY_MS = 1000
# Threads of Zenoh that receive messages. A closed connection with unsent data blocks one for up to
# 10 s (SO_LINGER). With Zenoh's default of 2, four broken connections blocked those of all other
# programs for up to 9 s (docs/benchmarks/faults.md). Zenoh reads this variable at its first use.
RUNTIME_VARIABLE, RUNTIME = "ZENOH_RUNTIME", "(rx: (worker_threads: 16))"
LEAVE_WITHIN_S = 2.0  # Time to send pending messages when a transport closes.


def open_session(network: Endpoint, router: bool = False) -> zenoh.Session:
    """Open a Zenoh session for a `with` block, as a router or as the client of a router.

    Raises:
        ConfigError: The endpoint is malformed.
        UnavailableError: The port is in use, no service replies on the endpoint, or the keys are
            rejected.
    """
    try:
        config = _session_config(network, router)
    except zenoh.ZError:
        raise ConfigError(
            f"endpoint {network.endpoint!r} is malformed: write it like {DEFAULT_ENDPOINT}."
        ) from None
    try:
        return _open(config)
    except zenoh.ZError as error:
        advice = why_not_listening(network) if router else _why_not_connected(network)
        raise UnavailableError(f"{advice} ({str(error).split(' at /')[0]})") from None


def open_front_router(network: Endpoint, keys: TlsKeys, port: int) -> zenoh.Session:
    """Open a further router with renewed keys, connected to the router of a service.

    Args:
        network: Endpoint of the service, with a Unix socket.
        keys: The renewed keys.
        port: Port on loopback on which the router listens. The gate (`connection_gate`) passes
            connections of other machines on to it.

    Raises:
        ConfigError: The keys, or `access.yaml` in their folder, cannot be used.
    """
    listen = f"tls/{LOOPBACK}:{port}"
    config = _session_config(replace(network, keys=keys, behind_gate=listen), router=True)
    config.insert_json5("listen/endpoints", json.dumps([listen]))
    config.insert_json5("connect/endpoints", json.dumps([network.local_endpoint]))
    try:
        return _open(config)
    except zenoh.ZError as error:
        raise ConfigError(
            f"the router cannot start with the keys in {keys.folder}: {error}. Copy the keys of "
            "this host into the folder again."
        ) from None


def _open(config: zenoh.Config) -> zenoh.Session:
    os.environ.setdefault(RUNTIME_VARIABLE, RUNTIME)
    return zenoh.open(config)


def _session_config(network: Endpoint, router: bool) -> zenoh.Config:
    local = [network.local_endpoint] if router and network.local_socket else []
    settings = {
        "mode": "router" if router else "client",
        "listen/endpoints" if router else "connect/endpoints": [
            (router and network.behind_gate) or network.endpoint,
            *local,
        ],
        **CLOSED,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/rx/max_message_size": network.max_message_mb * 1_000_000,
        "connect/timeout_ms": CONNECT_WITHIN_MS,
        "connect/retry": {"period_max_ms": MAX_RETRY_MS},
        **(network.keys.settings(router, network.robot if local else "") if network.keys else {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def why_not_listening(network: Endpoint) -> str:
    return (
        f"cannot listen on {network.endpoint}: is another `ldo serve` running there? "
        "Stop it, or choose another port with --endpoint."
    )


def _why_not_connected(network: Endpoint) -> str:
    host, port = network.address
    if network.keys and port.isdecimal() and (why := network.keys.tls_error(host, int(port))):
        return (
            f"the service on {network.endpoint} and the keys in {network.keys.folder} do not "
            f"accept each other: {why}. `ldo keys list` shows the valid keys; service and client "
            "need keys of the same authority."
        )
    return (
        f"no service replies on {network.endpoint}: start `ldo serve`, "
        "or give the address of a running service: --endpoint, or connect(robot, endpoint)."
    )


class ZenohTransport:
    """Transport over a Zenoh session."""

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        """Initialize inside a running event loop.

        Args:
            session: Open session, which must stay open until `close`.
            network: Endpoint of the robot.
        """
        self._session, self._network = session, network
        self._loop = asyncio.get_running_loop()
        self._declared: list[Any] = []
        self._publishers: list[ZenohPublisher] = []
        # Queries for values and commands have separate limits and threads, so that slow readers of
        # values do not delay commands.
        self._answering, self._commanding = Worker("answers"), Worker("commands")
        self._responding: set[asyncio.Task[None]] = set()
        self._query_slots = BoundedSemaphore(MAX_QUERIES)
        self._command_slots = BoundedSemaphore(MAX_QUERIES)

    def publisher(self, key: str) -> "ZenohPublisher":
        """Create a publisher on a key."""
        publisher = ZenohPublisher(self._session, self._network.expression(key))
        self._publishers.append(publisher)
        return publisher

    def subscribe(self, key: str, on_message: OnMessage) -> None:
        """Subscribe to a key; `on_message` runs on Zenoh's thread."""

        def store(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            header = attachment.to_bytes() if attachment is not None else b""
            on_message(header, memoryview(sample.payload.to_bytes()))

        handler = zenoh.handlers.Callback(store, indirect=False)
        expression = self._network.expression(key)
        self._declared.append(self._session.declare_subscriber(expression, handler))

    def declare_liveliness(self, name: str) -> None:
        """Declare an actor alive until this process ends."""
        expression = self._network.expression(f"{ALIVE}/{name}")
        self._declared.append(self._session.liveliness().declare_token(expression))

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        """Subscribe to the liveliness of all actors."""

        def changed(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).rsplit("/", 1)[1]
            alive = sample.kind == zenoh.SampleKind.PUT
            call_soon(self._loop, on_presence, name, alive)

        handler = zenoh.handlers.Callback(changed, indirect=False)
        expression = self._network.expression(f"{ALIVE}/*")
        liveliness = self._session.liveliness()
        self._declared.append(liveliness.declare_subscriber(expression, handler, history=True))

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        """Reply to each query on a key with the messages that `last_values` returns."""
        expression = self._network.expression(key)

        def reply(query: zenoh.Query) -> None:
            try:
                with query, suppress(zenoh.ZError):  # The client may have disconnected.
                    for header, body in last_values():
                        query.reply(expression, body, attachment=header)
            finally:
                self._query_slots.release()

        def on_query(query: zenoh.Query) -> None:
            if self._query_slots.acquire(blocking=False):
                self._answering.submit(reply, query)
            else:
                with query:
                    query.reply_err(b"too many queries: ask again later")

        handler = zenoh.handlers.Callback(on_query, indirect=False)
        self._declared.append(self._session.declare_queryable(expression, handler))

    def respond(self, key: str, respond: Callable[[bytes], Awaitable[bytes]]) -> None:
        """Reply to each query on a key with the result of a coroutine on the event loop.

        Use this method for requests that take time, and `serve_queries` for existing values.

        Args:
            key: Key of the queries.
            respond: Coroutine function that takes the payload of a query and returns the payload of
                the reply.
        """
        expression = self._network.expression(key)

        async def reply(query: zenoh.Query, request: bytes) -> None:
            try:
                with query, suppress(zenoh.ZError):  # The client may have disconnected.
                    body = await respond(request)
                    await self._commanding.run(query.reply, expression, body)
            finally:
                self._command_slots.release()

        def start(query: zenoh.Query, request: bytes) -> None:
            task = self._loop.create_task(reply(query, request))
            self._responding.add(task)
            task.add_done_callback(self._responding.discard)

        def on_query(query: zenoh.Query) -> None:
            if self._command_slots.acquire(blocking=False):
                payload = query.payload
                request = payload.to_bytes() if payload is not None else b""
                call_soon(self._loop, start, query, request)
            else:
                with query:
                    query.reply_err(b"too many queries: ask again later")

        handler = zenoh.handlers.Callback(on_query, indirect=False)
        self._declared.append(self._session.declare_queryable(expression, handler))

    def close(self) -> None:
        """End all subscriptions, query handlers and liveliness tokens.

        All publishers together have `LEAVE_WITHIN_S` to send pending messages.
        """
        for task in self._responding:
            task.cancel()
        for declared in self._declared:
            with suppress(zenoh.ZError):  # The session may be closed already.
                declared.undeclare()
        self._declared.clear()
        self._answering.close()
        self._commanding.close()
        until_s = time.monotonic() + LEAVE_WITHIN_S
        for leaving in (*self._publishers, self._answering, self._commanding):
            leaving.close()
            leaving.join(max(0.0, until_s - time.monotonic()))


class ZenohPublisher:
    """Publisher on one key, with a thread of its own.

    Messages on the key stay in order. They never wait for messages on other keys.
    """

    def __init__(self, session: zenoh.Session, expression: str) -> None:
        self._publisher = session.declare_publisher(
            expression, congestion_control=zenoh.CongestionControl.DROP
        )
        self._thread = Worker(f"put {expression}")
        self._lock = Lock()
        self._posted: tuple[bytes, bytes] | None = None

    def send(self, header: bytes, body: bytes) -> Awaitable[None]:
        """Send a message.

        The returned awaitable is done when the message has been sent or dropped.
        """
        return self._thread.run(self._put, header, body)

    def post(self, header: bytes, body: bytes) -> None:
        """Send a message without waiting.

        The message replaces an earlier posted message that was not sent yet.
        """
        with self._lock:
            is_under_way, self._posted = self._posted is not None, (header, body)
        if not is_under_way:
            self._thread.submit(self._put_posted)

    def _put_posted(self) -> None:
        with self._lock:
            posted, self._posted = self._posted, None
        if posted is not None:
            self._put(*posted)

    def _put(self, header: bytes, body: bytes) -> None:
        try:
            self._publisher.put(body, attachment=header)
        except zenoh.ZError as error:
            log.warning("%s: publishing a message failed (%s), so this message is lost. Check the "
                        "connection to the router.", self._publisher.key_expr, error)  # fmt: skip

    def close(self) -> None:
        """Accept no more messages; send those accepted so far."""
        self._thread.submit(self._undeclare)
        self._thread.close()

    def join(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` for the end of the thread; call `close` first."""
        self._thread.join(timeout_s)

    def _undeclare(self) -> None:
        with suppress(zenoh.ZError):
            self._publisher.undeclare()
