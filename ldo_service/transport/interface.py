"""What the runtime needs of a network, and the network within one process."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol

OnMessage = Callable[[bytes, memoryview], None]  # header, body; may be called on any thread
OnPresence = Callable[[str, bool], None]  # name, alive; called on the event loop
LastValues = Callable[[], Sequence[tuple[bytes, bytes]]]  # on any thread; header, body of each part


class Publisher(Protocol):
    """Sends on one key. Nothing here blocks the event loop; after `close` nothing is sent."""

    def send(self, header: bytes, body: bytes) -> Awaitable[None]:
        """Send; done when the message has left, or was given up to congestion."""
        ...

    def post(self, header: bytes, body: bytes) -> None:
        """Send soon; a newer post replaces one that has not left yet."""
        ...

    def close(self) -> None: ...


class Transport(Protocol):
    """Keys are relative to the robot: `data/...` of topics, and the runtime's own.

    Messages may be lost, and those of one publisher stay in order: what must arrive is numbered,
    acknowledged and sent again by `ldo_service.transport.flow_control`.
    """

    def publisher(self, key: str) -> Publisher: ...

    def subscribe(self, key: str, on_message: OnMessage) -> None: ...

    def declare_liveliness(self, name: str) -> None:
        """Be seen as alive until this process ends."""
        ...

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        """Be told who is alive, who joins and who is gone."""
        ...

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        """Answer queries on a key with its last values.

        The parts of a value share the key: over Zenoh, ask with consolidation NONE to get all.
        """
        ...

    def close(self) -> None: ...


def call_soon(loop: asyncio.AbstractEventLoop, callback: Callable[..., None], *args: Any) -> None:
    """On any thread, even one that outlives the loop: then there is nobody left to tell."""
    with suppress(RuntimeError):
        loop.call_soon_threadsafe(callback, *args)


class MemoryTransport:
    """All stages in one event loop; delivery is immediate. `lose` drops messages, for tests."""

    def __init__(self, lose: Callable[[str], bool] = lambda _key: False) -> None:
        self._subscribers: dict[str, list[OnMessage]] = {}
        self._watchers: list[OnPresence] = []
        self._alive: list[str] = []
        self._answers: dict[str, LastValues] = {}
        self._lose = lose

    def publisher(self, key: str) -> "MemoryPublisher":
        return MemoryPublisher(self, key)

    def deliver(self, key: str, header: bytes, body: bytes) -> None:
        if not self._lose(key):
            for on_message in list(self._subscribers.get(key, ())):
                on_message(header, memoryview(body))

    def subscribe(self, key: str, on_message: OnMessage) -> None:
        self._subscribers.setdefault(key, []).append(on_message)

    def declare_liveliness(self, name: str) -> None:
        self._alive.append(name)
        for on_presence in self._watchers:
            on_presence(name, True)

    def leave(self, name: str) -> None:
        """What a killed process looks like to the others."""
        self._alive.remove(name)
        for on_presence in self._watchers:
            on_presence(name, False)

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        self._watchers.append(on_presence)
        for name in self._alive:
            on_presence(name, True)

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        self._answers[key] = last_values

    def query(self, key: str) -> Sequence[tuple[bytes, bytes]]:
        return self._answers[key]() if key in self._answers else ()

    def close(self) -> None:
        self._subscribers.clear()


class MemoryPublisher:
    def __init__(self, transport: MemoryTransport, key: str) -> None:
        self._transport, self._key = transport, key
        self._closed = False

    async def send(self, header: bytes, body: bytes) -> None:
        self.post(header, body)

    def post(self, header: bytes, body: bytes) -> None:
        if not self._closed:
            self._transport.deliver(self._key, header, body)

    def close(self) -> None:
        self._closed = True
