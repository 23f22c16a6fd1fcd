"""Interface between the runtime and the network, and an implementation in memory."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol

OnMessage = Callable[[bytes, memoryview], None]  # Header, body; may be called on any thread.
OnPresence = Callable[[str, bool], None]  # Name, alive; called on the event loop.
# Header and body of each part; may be called on any thread.
LastValues = Callable[[], Sequence[tuple[bytes, bytes]]]


class Publisher(Protocol):
    """Publisher on one key; its methods do not block the event loop."""

    def send(self, header: bytes, body: bytes) -> Awaitable[None]:
        """Send a message.

        The returned awaitable is done when the message has been sent, or dropped because of
        congestion.
        """
        ...

    def post(self, header: bytes, body: bytes) -> None:
        """Send a message without waiting.

        The message replaces an earlier posted message that was not sent yet.
        """
        ...

    def close(self) -> None:
        """Stop sending."""
        ...


class Transport(Protocol):
    """Network between actors; keys are relative to the key prefix of the robot.

    Messages may be lost. Messages of one publisher stay in order.
    `ldo_service.transport.flow_control` adds lossless delivery: it numbers, acknowledges and
    retransmits messages.
    """

    def publisher(self, key: str) -> Publisher:
        """Create a publisher on a key."""
        ...

    def subscribe(self, key: str, on_message: OnMessage) -> None:
        """Call `on_message` for each message on a key; the call may be on any thread."""
        ...

    def declare_liveliness(self, name: str) -> None:
        """Declare an actor alive until this process ends."""
        ...

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        """Subscribe to the liveliness of all actors, including those that are already alive."""
        ...

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        """Reply to each query on a key with the messages that `last_values` returns.

        All these messages have the same key. A Zenoh query therefore needs consolidation NONE to
        get all of them.
        """
        ...

    def close(self) -> None:
        """End all subscriptions and publishers."""
        ...


def call_soon(loop: asyncio.AbstractEventLoop, callback: Callable[..., None], *args: Any) -> None:
    """Schedule a callback on the event loop from any thread, unless the loop is closed."""
    with suppress(RuntimeError):
        loop.call_soon_threadsafe(callback, *args)


class MemoryTransport:
    """Transport in memory, for actors in one event loop; delivery is immediate."""

    def __init__(self, lose: Callable[[str], bool] = lambda _key: False) -> None:
        """Initialize without subscribers.

        Args:
            lose: Function from the key of a message to True if the message is to be lost; for
                tests.
        """
        self._subscribers: dict[str, list[OnMessage]] = {}
        self._watchers: list[OnPresence] = []
        self._alive: list[str] = []
        self._answers: dict[str, LastValues] = {}
        self._lose = lose

    def publisher(self, key: str) -> "MemoryPublisher":
        """Create a publisher on a key."""
        return MemoryPublisher(self, key)

    def deliver(self, key: str, header: bytes, body: bytes) -> None:
        """Deliver a message to the subscribers of a key, unless `lose` is True for the key."""
        if not self._lose(key):
            for on_message in list(self._subscribers.get(key, ())):
                on_message(header, memoryview(body))

    def subscribe(self, key: str, on_message: OnMessage) -> None:
        """Subscribe to a key."""
        self._subscribers.setdefault(key, []).append(on_message)

    def declare_liveliness(self, name: str) -> None:
        """Declare an actor alive until `leave` is called."""
        self._alive.append(name)
        for on_presence in self._watchers:
            on_presence(name, True)

    def leave(self, name: str) -> None:
        """Declare an actor no longer alive, as if its process had been killed."""
        self._alive.remove(name)
        for on_presence in self._watchers:
            on_presence(name, False)

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        """Subscribe to the liveliness of all actors."""
        self._watchers.append(on_presence)
        for name in self._alive:
            on_presence(name, True)

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        """Reply to each query on a key with the messages that `last_values` returns."""
        self._answers[key] = last_values

    def query(self, key: str) -> Sequence[tuple[bytes, bytes]]:
        """Return header and body of each message that replies to a query; empty if none does."""
        return self._answers[key]() if key in self._answers else ()

    def close(self) -> None:
        """End all subscriptions."""
        self._subscribers.clear()


class MemoryPublisher:
    """Publisher of a `MemoryTransport`."""

    def __init__(self, transport: MemoryTransport, key: str) -> None:
        self._transport, self._key = transport, key
        self._closed = False

    async def send(self, header: bytes, body: bytes) -> None:
        """Deliver a message immediately."""
        self.post(header, body)

    def post(self, header: bytes, body: bytes) -> None:
        """Deliver a message immediately."""
        if not self._closed:
            self._transport.deliver(self._key, header, body)

    def close(self) -> None:
        """Stop sending."""
        self._closed = True
