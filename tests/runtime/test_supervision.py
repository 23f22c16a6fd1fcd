"""Tests of supervision: an error ends all stages of a process, a stop ends them in order."""

import asyncio
import subprocess
import sys
from itertools import count
from threading import Event

import pytest

from ldo_service.errors import RestartsExhausted
from ldo_service.runtime.actor import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage, SupervisionConfig
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.transport.flow_control import data_key
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import (
    DOUBLES,
    NUMBERS,
    QUICK,
    DoubleCollector,
    Doubler,
    collector,
    eventually,
    number,
    send,
)


async def test_soft_stop_loses_no_messages_in_flight() -> None:
    transport, seen, stop = MemoryTransport(), [], StopRequest()
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, ["doubler"])
    expected = {DOUBLES.name: frozenset({"double_collector"})}
    doubler = Stage(Doubler, transport, config=QUICK, expected=expected)
    last = Stage(lambda: DoubleCollector(seen), transport, config=QUICK)
    service = asyncio.create_task(supervise([doubler, last], stop))
    for value in range(20):
        await send(numbers, number(value))
    await numbers.flush()
    stop.request()
    await service
    assert seen == [2 * value for value in range(20)]


async def test_soft_stop_waits_for_retransmissions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Outlet, "REPEAT_AFTER_S", 0.01)
    transport = MemoryTransport(lose=lambda key: key == data_key(DOUBLES.name))
    seen, stop = [], StopRequest()
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, ["doubler"])
    expected = {DOUBLES.name: frozenset({"double_collector"})}
    doubler = Stage(Doubler, transport, config=QUICK, expected=expected)
    last = Stage(lambda: DoubleCollector(seen), transport, config=QUICK)
    service = asyncio.create_task(supervise([doubler, last], stop))
    for value in range(7):
        await send(numbers, number(value))
    await numbers.flush()
    stop.request()
    await service
    assert seen == [2 * value for value in range(7)]


async def test_hard_stop_ends_at_once() -> None:
    transport, stop, release = MemoryTransport(), StopRequest(), Event()
    stage = collector(transport, [], lambda _value: release.wait(60) and None)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, ["collector"])
    service = asyncio.create_task(supervise([stage], stop, drain_s=1000))
    await send(numbers, number(0))
    await eventually(lambda: stage.health().state == "busy")
    stop.request()
    await asyncio.sleep(0.01)
    assert not service.done()
    stop.request()
    await asyncio.wait_for(service, 60)
    release.set()


async def test_stage_that_exceeds_its_drain_time_is_cancelled() -> None:
    transport, stop = MemoryTransport(), StopRequest()
    stage = collector(transport, [])
    stage.drain = lambda: None  # type: ignore[method-assign]
    stop.request()
    await asyncio.wait_for(supervise([stage], stop, drain_s=0.01), 60)


async def test_stop_of_many_stages_that_do_not_drain_is_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Slow:
        name = "slow"

        async def run(self) -> None:
            await asyncio.Event().wait()

        def drain(self) -> None: ...

        def health(self) -> None: ...

    loop, skipped_s = asyncio.get_running_loop(), 0.0
    real_time, real_wait = loop.time, asyncio.wait

    async def wait_without_delay(tasks: set, timeout: float | None = None, **options) -> object:
        """Advance the clock by the time limit instead of waiting for it."""
        nonlocal skipped_s
        if timeout is None:
            return await real_wait(tasks, **options)
        skipped_s += timeout
        return await real_wait(tasks, timeout=0, **options)

    monkeypatch.setattr(loop, "time", lambda: real_time() + skipped_s)
    monkeypatch.setattr(asyncio, "wait", wait_without_delay)
    stop = StopRequest()
    stop.request()
    await supervise([Slow() for _ in range(7)], stop, drain_s=1000)
    assert 1500 <= skipped_s <= 2100


async def test_exhausted_restart_budget_ends_all_stages() -> None:
    tries = count()

    def fail(_value: int) -> None:
        if next(tries) % 2 == 0:
            raise RuntimeError("once")

    transport, stop = MemoryTransport(), StopRequest()
    config = SupervisionConfig(heartbeat_s=0.02, restart_delay_s=0.001, max_restarts=0)
    bad, good = collector(transport, [], fail, config=config), Stage(Doubler, transport)
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, ["collector"])
    service = asyncio.create_task(supervise([good, bad], stop))
    await send(numbers, number(0))
    with pytest.raises(RestartsExhausted, match="collector"):
        await asyncio.wait_for(service, 60)
    left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    assert left == []


async def test_second_error_during_a_soft_stop_leaves_no_task() -> None:
    class Failing:
        name = "failing"

        def __init__(self) -> None:
            self._is_requested = asyncio.Event()

        async def run(self) -> None:
            await self._is_requested.wait()
            raise RestartsExhausted("failing", 1, 1.0)

        def drain(self) -> None:
            self._is_requested.set()

    stop = StopRequest()
    stop.request()
    with pytest.raises(RestartsExhausted):
        await supervise([Failing(), Failing()], stop)
    await asyncio.sleep(0)
    assert asyncio.all_tasks() == {asyncio.current_task()}


STUCK = """
import asyncio, time
from ldo_service.errors import StageStalled
from ldo_service.runtime import Actor, In, Latest
from ldo_service.runtime.stage import Stage, SupervisionConfig
from ldo_service.runtime.supervision import StopRequest, supervise
from ldo_service.transport.interface import MemoryTransport
from ldo_service.schemas import Health, encode
from ldo_service.schemas.topics import Topic

ANY = Topic("any", Health, "")

class Stuck(Actor):
    name, inputs = "stuck", (In(ANY, Latest(1)),)

    def handle(self, message):
        time.sleep(1e6)
        yield from ()

async def main():
    transport = MemoryTransport()
    stage = Stage(Stuck, transport, config=SupervisionConfig(heartbeat_s=0.02, stall_after_s=0.1))
    service = asyncio.create_task(supervise([stage], StopRequest()))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    transport.deliver("any", b"", encode(stage.health()))
    try:
        await service
    except StageStalled as error:
        print("stalled:", error)

asyncio.run(main())
"""


def test_interpreter_exits_while_a_handler_is_stuck() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STUCK], capture_output=True, text=True, check=False
    )
    assert "stalled: stuck has been busy" in done.stdout
    assert (done.returncode, done.stderr) == (0, "")
