"""All stages of a process in one task group: an error that a stage gives up on ends them all."""

import asyncio
import logging
from collections.abc import Sequence
from typing import Protocol

log = logging.getLogger(__name__)


class Runner(Protocol):
    """A stage in this process, or the process of one."""

    name: str

    async def run(self) -> None: ...

    def drain(self) -> None: ...


class Stop:
    """Asked once: soft, each stage finishes what it has. Asked twice: hard, at once."""

    def __init__(self) -> None:
        self._soft, self._hard = asyncio.Event(), asyncio.Event()

    def ask(self) -> None:
        (self._hard if self._soft.is_set() else self._soft).set()

    @property
    def is_asked(self) -> bool:
        return self._soft.is_set()

    async def wait_soft(self) -> None:
        await self._soft.wait()

    async def wait_hard(self) -> None:
        await self._hard.wait()


async def supervise(runners: Sequence[Runner], stop: Stop, drain_s: float = 10.0) -> None:
    """Run until asked to stop; then end them in the given order, producers first.

    Raises what a runner gave up on (RestartsExhausted, StageStalled).
    """
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(runner.run(), name=runner.name) for runner in runners]
            await stop.wait_soft()
            hard = asyncio.create_task(stop.wait_hard())
            try:
                for runner, task in zip(runners, tasks, strict=True):
                    await _end(runner, task, hard, drain_s)
            finally:
                hard.cancel()
    except BaseExceptionGroup as errors:
        raise _first(errors) from None


async def _end(
    runner: Runner, task: asyncio.Task[None], hard: asyncio.Task[None], drain_s: float
) -> None:
    if not hard.done():
        runner.drain()
        await asyncio.wait({task, hard}, timeout=drain_s, return_when=asyncio.FIRST_COMPLETED)
    if not task.done():
        log.warning("%s did not end in time: cancelled", runner.name)
        task.cancel()


def _first(errors: BaseExceptionGroup) -> BaseException:
    """The error that ended the group; the others followed from it."""
    error: BaseException = errors
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
