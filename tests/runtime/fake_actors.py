"""Messages, topics and actors for the tests of the runtime."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from typing import Any, Protocol

from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.runtime.actor import Policy
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage, SupervisionConfig
from ldo_service.schemas import Message, encode
from ldo_service.schemas.topics import Topic
from ldo_service.transport.interface import Transport

# Limit after which a test gives up. No test result depends on how long a step takes.
PATIENCE_S = 60.0


class Number(Message, frozen=True, kw_only=True):
    value: int
    region: str = ""
    data: bytes = b""


class Double(Message, frozen=True, kw_only=True):
    value: int


class Piece(Message, frozen=True, kw_only=True):
    version: int
    part: int
    parts: int


NUMBERS = Topic("test/number", Number, "a number", key="region")
LATEST_NUMBER = Topic("test/latest", Number, "a number", is_state=True)
DOUBLES = Topic("test/double", Double, "twice the number")
PIECES = Topic("test/piece", Piece, "a value in parts", is_state=True)

WINDOW_OF_FOUR = Lossless(4)
QUICK = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001)


def number(value: int, **fields: Any) -> Number:
    return Number(stamp_ns=value, value=value, **fields)


async def send(outlet: Outlet, message: Message) -> None:
    await outlet.send(message, encode(message))


async def eventually(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "the condition was not met in time"
        await asyncio.sleep(0.002)


class Collector(Actor):
    """An actor that calls `think` with each number and appends it to a list."""

    name = "collector"
    inputs = (In(NUMBERS, Lossless(4)),)

    def __init__(self, seen: list[int], think: Callable[[int], None] = lambda _value: None) -> None:
        super().__init__()
        self._seen, self._think = seen, think

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self._think(message.value)
        self._seen.append(message.value)
        yield from ()


def collector(
    transport: Transport,
    seen: list[int],
    think: Callable[[int], None] = lambda _value: None,
    *,
    policy: Policy = WINDOW_OF_FOUR,
    name: str = "collector",
    config: SupervisionConfig = QUICK,
) -> Stage:
    members = {"name": name, "inputs": (In(NUMBERS, policy),)}
    kind = type("NamedCollector", (Collector,), members)
    return Stage(lambda: kind(seen, think), transport, config=config)


class Doubler(Actor):
    name = "doubler"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES),)

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        yield Double(stamp_ns=message.stamp_ns, value=2 * message.value)


class DoubleCollector(Actor):
    name = "double_collector"
    inputs = (In(DOUBLES, Lossless(2)),)

    def __init__(self, seen: list[int]) -> None:
        super().__init__()
        self._seen = seen

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Double)
        self._seen.append(message.value)
        yield from ()


class Runs(Protocol):
    async def run(self) -> None: ...


@asynccontextmanager
async def running(*runners: Runs) -> AsyncIterator[Sequence[asyncio.Task[None]]]:
    """Run stages until the block ends, then cancel them and raise what they raised."""
    tasks = [asyncio.create_task(runner.run()) for runner in runners]
    await asyncio.sleep(0)  # Lets each stage open its ports.
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result
