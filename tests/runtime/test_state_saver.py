"""Tests of the generations that a stage writes in the background, also on a bad disk."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from threading import Event

import pytest

from ldo_service.runtime import Out, generations, state_saver
from ldo_service.runtime.generations import GenerationKeeper, completed_generation
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import CommandSender
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import DOUBLES, NUMBERS, QUICK, Doubler, eventually, number, running, send


class Disk:
    """A disk that fails as often as a test wants, or waits."""

    def __init__(self) -> None:
        self.failures = 0
        self.is_free = Event()
        self.is_free.set()
        self.synced: list[set[str]] = []

    def sync_all(self, paths: Iterable[Path]) -> None:
        self.synced.append({path.name for path in paths if path.suffix == ".log"})
        assert self.is_free.wait(60)
        if self.failures:
            self.failures -= 1
            raise OSError(5, "Input/output error")


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    monkeypatch.setattr(state_saver, "sync_all", disk.sync_all)
    return disk


@asynccontextmanager
async def running_doubler(store: FolderStore) -> AsyncIterator[CommandSender]:
    """Run a stage whose outbox on disk has a message, and yield a client that commands it."""
    transport, absent = MemoryTransport(), {DOUBLES.name: frozenset({"absent"})}
    stage = Stage(
        Doubler, transport, config=QUICK, store=store, expected=absent, with_backlog=absent
    )
    numbers = Outlet(Out(NUMBERS), "source", 1, transport, {"doubler"})
    async with running(stage):
        await send(numbers, number(1))
        await eventually(lambda: stage.health().steps == 1)
        yield CommandSender(transport)


@asynccontextmanager
async def doubler(folder: Path) -> AsyncIterator[Callable[[int], Awaitable[str]]]:
    """Run a stage whose outbox on disk has a message, and yield a function that keeps its state."""
    async with running_doubler(FolderStore(folder)) as sender:

        async def keep(generation: int) -> str:
            return await sender.send("keep", "doubler", 60, (generation, 0))

        yield keep


async def test_files_of_outboxes_are_synced_again_after_a_failed_sync(
    tmp_path: Path, disk: Disk
) -> None:
    disk.failures = 2
    async with doubler(tmp_path) as keep:
        for generation in (1, 2):
            assert "Input/output error" in await keep(generation)
        assert [await keep(generation) for generation in (3, 4)] == ["", ""]
    log = disk.synced[0]
    assert len(log) == 1
    assert disk.synced == [log, log, log, set()]


async def test_unexpected_error_of_a_write_is_reported_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("no thread")

    monkeypatch.setattr(state_saver, "sync_all", fail)
    async with doubler(tmp_path) as keep:
        assert "RuntimeError('no thread')" in await keep(1)
    assert "Please report the traceback" in caplog.text


async def test_generation_is_not_begun_while_the_one_before_is_written(
    tmp_path: Path, disk: Disk
) -> None:
    async with doubler(tmp_path) as keep:
        disk.is_free.clear()
        first = asyncio.create_task(keep(1))
        await eventually(lambda: disk.synced)
        for generation in (2, 3):
            assert await keep(generation) == "is still writing the previous generation"
        assert len(disk.synced) == 1
        disk.is_free.set()
        assert await first == ""
        assert await keep(4) == ""


async def test_write_that_takes_longer_than_the_time_limit_completes_a_generation_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generations, "KEEP_WITHIN_S", 0.05)
    monkeypatch.setattr(generations, "KEEP_EVERY_S", 0.01)
    monkeypatch.setattr(state_saver, "sync_all", lambda _: time.sleep(0.3))
    store = FolderStore(tmp_path / "state")
    async with running_doubler(store) as sender:
        task = asyncio.create_task(GenerationKeeper(sender, store, ["doubler"]).run())
        await eventually(lambda: completed_generation(store) is not None)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
