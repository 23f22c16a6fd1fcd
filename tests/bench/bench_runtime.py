"""Throughput of lossless links, and the time until a killed consumer releases its producer.

    python tests/bench/bench_runtime.py

Producer and consumer have sessions of their own to a router on loopback. The consumer to be killed
is a process. The ideal of the total time is the computing time of the consumer.
"""

import asyncio
import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass

from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.process import resident_mb
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import Message, encode
from ldo_service.schemas.topics import Topic
from ldo_service.transport.zenoh_transport import Endpoint, ZenohTransport, open_session

MESSAGES, MESSAGE_BYTES, STEP_S, WINDOW = 300, 1_000_000, 0.010, 4


class Block(Message, frozen=True, kw_only=True):
    data: memoryview


BLOCKS = Topic("bench/block", Block, "a megabyte")


class Consumer(Actor):
    name = "consumer"
    inputs = (In(BLOCKS, Lossless(WINDOW)),)

    def __init__(self, step_s: float = STEP_S) -> None:
        super().__init__()
        self._step_s = step_s

    def handle(self, message: Message) -> Iterator[Message]:  # noqa: ARG002
        time.sleep(self._step_s)
        yield from ()


@dataclass(frozen=True)
class Throughput:
    total_s: float
    deepest: int
    growth_mb: float
    repeated: int


async def throughput(network: Endpoint) -> Throughput:
    with open_session(network) as one, open_session(network) as other:
        outlet = Outlet(
            Out(BLOCKS), "producer", 1, ZenohTransport(one, network), expected=["consumer"]
        )
        stage = Stage(Consumer, ZenohTransport(other, network))
        async with running(stage):
            await consumer_joined(outlet)
            message = Block(stamp_ns=0, data=memoryview(bytes(MESSAGE_BYTES)))
            before_mb, max_mb, started_s = resident_mb(), 0.0, time.perf_counter()
            for _ in range(MESSAGES):
                await outlet.send(message, encode(message))
                max_mb = max(max_mb, resident_mb())
            while stage.health().inputs[0].delivered < MESSAGES:
                await asyncio.sleep(0.001)
            total_s = time.perf_counter() - started_s
            deepest = stage.health().inputs[0].peak_queued
    return Throughput(total_s, deepest, max_mb - before_mb, outlet.counts().retransmitted)


async def release_ms(network: Endpoint) -> float:
    """Return the time from the kill of a consumer with a full window to the next sent message."""
    with open_session(network) as session:
        outlet = Outlet(Out(BLOCKS), "producer", 1, ZenohTransport(session, network))
        child = subprocess.Popen([sys.executable, __file__, "--stuck-consumer", network.endpoint])
        await consumer_joined(outlet)
        message = Block(stamp_ns=0, data=memoryview(b"x"))
        for _ in range(WINDOW):
            await outlet.send(message, encode(message))
        started_s = time.perf_counter()
        child.kill()
        await outlet.send(message, encode(message))
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        child.wait()
        return elapsed_ms


async def consumer_joined(outlet: Outlet) -> None:
    while outlet.credits() != WINDOW:
        await asyncio.sleep(0.001)


@contextlib.asynccontextmanager
async def running(stage: Stage) -> AsyncIterator[None]:
    task = asyncio.create_task(stage.run())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def stuck_consumer(endpoint: str) -> None:
    network = Endpoint("bench", endpoint)
    with open_session(network) as session:
        await Stage(lambda: Consumer(1e6), ZenohTransport(session, network)).run()


async def main() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    network = Endpoint("bench", f"tcp/127.0.0.1:{port}")
    with open_session(network, router=True):
        runs = [await throughput(network) for _ in range(3)]
        releases = sorted([await release_ms(network) for _ in range(5)])
    best = min(runs, key=lambda run: run.total_s)
    mb = MESSAGE_BYTES / 1e6
    print(f"{MESSAGES} messages of {mb:g} MB, {1e3 * STEP_S:g} ms per step, window {WINDOW}")
    print("| measure | value |\n|---|---|")
    print(f"| total, 3 runs | {', '.join(f'{run.total_s:.2f} s' for run in runs)} |")
    print(f"| ideal | {MESSAGES * STEP_S:.2f} s |")
    print(f"| deepest queue | {max(run.deepest for run in runs)} |")
    print(f"| memory growth | {max(run.growth_mb for run in runs):.0f} MB |")
    print(f"| retransmitted | {best.repeated} |")
    print(f"| release after a kill, median of 5 | {releases[2]:.1f} ms (max {releases[4]:.1f}) |")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stuck-consumer"]:
        asyncio.run(stuck_consumer(sys.argv[2]))
    else:
        asyncio.run(main())
