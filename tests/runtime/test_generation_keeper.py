"""Tests of the task that keeps generations of the states of all actors, also after failures."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from ldo_service.runtime import generations
from ldo_service.runtime.generations import (
    FAILURES_TO_LOG,
    GenerationKeeper,
    completed_generation,
    problem_of_completed,
    problem_of_states,
)
from ldo_service.runtime.stage_commands import CommandSender, What
from ldo_service.storage import atomic_write
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.interface import MemoryPublisher, MemoryTransport

from .fake_actors import eventually
from .test_generations import ACTORS, save_consumer, save_producer


class Stages(CommandSender):
    """Stages that keep their saved states at once, or fail as the test wants."""

    def __init__(self, store: FolderStore) -> None:
        super().__init__(MemoryTransport())
        self._store = store
        self.errors: dict[str, str | Exception] = {}
        self.limits_s: list[float] = []
        self.kept: list[tuple[str, int, int]] = []
        self.before_keep: Callable[[str], None] = lambda _actor: None

    async def send(
        self, what: What, stage: str, timeout_s: float, generation: tuple[int, int] = (0, 0)
    ) -> str:
        assert what == "keep"
        self.limits_s.append(timeout_s)
        self.before_keep(stage)
        error = self.errors.get(stage, "")
        if isinstance(error, Exception):
            raise error
        if not error:
            self._store.keep(stage, *generation).write()
            self.kept.append((stage, *generation))
        return error


class Scene:
    """A producer with eight messages, two consumers, and the task that keeps their states."""

    def __init__(self, folder: Path) -> None:
        self.store = FolderStore(folder / "state")
        save_producer(self.store, 8, (6, 7))
        save_consumer(self.store, "mapper", 6)
        save_consumer(self.store, "optimizer", 8)
        self.stages = Stages(self.store)
        self.keeper = GenerationKeeper(self.stages, self.store, ACTORS[::-1])

    def handle_message(self) -> None:
        self.store.save("tracker", {"now": [9]})
        save_producer(self.store, 9, (6, 7, 8))


@pytest.fixture
async def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


async def test_states_are_kept_once_and_again_after_a_message(scene: Scene) -> None:
    assert await scene.keeper.keep() == ""
    assert completed_generation(scene.store) == 1
    assert scene.stages.kept == [(actor, 1, 0) for actor in reversed(ACTORS)], "consumers first"
    assert await scene.keeper.keep() == ""
    assert completed_generation(scene.store) == 1
    scene.handle_message()
    assert await scene.keeper.keep() == ""
    assert completed_generation(scene.store) == 2
    assert scene.stages.kept[-1] == ("tracker", 2, 1)
    assert await scene.keeper.keep(is_forced=True) == ""
    assert completed_generation(scene.store) == 3


async def test_actor_that_does_not_answer_leaves_the_older_generation_whole(scene: Scene) -> None:
    await scene.keeper.keep()
    scene.handle_message()
    scene.stages.errors["tracker"] = "did not answer within 5 s"
    for _ in range(3):
        assert await scene.keeper.keep() == "tracker did not answer within 5 s"
    assert completed_generation(scene.store) == 1
    assert problem_of_states(scene.store, ACTORS, 1) is None
    scene.stages.errors.clear()
    assert await scene.keeper.keep() == ""
    assert completed_generation(scene.store) == 5, "no number is used again"


async def test_actor_that_does_not_answer_has_more_time_from_then_on(scene: Scene) -> None:
    scene.stages.errors["optimizer"] = "did not answer within 5 s"  # It is asked first.
    for _ in range(6):
        await scene.keeper.keep()
    assert scene.stages.limits_s == [5, 10, 20, 40, 60, 60]
    scene.stages.errors.clear()
    assert await scene.keeper.keep() == ""
    assert scene.stages.limits_s[6:] == [60, 60, 60]


async def test_states_that_do_not_fit_do_not_complete_a_generation(scene: Scene) -> None:
    def handle(actor: str) -> None:
        if actor == "tracker":  # The mapper has kept its state before.
            save_producer(scene.store, 9, (8,))

    scene.stages.before_keep = handle
    assert "mapper lacks messages" in await scene.keeper.keep()
    assert completed_generation(scene.store) is None


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), OSError()])
async def test_full_disk_completes_no_generation(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    def fail(*_: object) -> None:
        raise error

    with monkeypatch.context() as full:
        full.setattr(generations, "complete_generation", fail)
        assert await scene.keeper.keep() == (str(error) or "OSError()")
    assert completed_generation(scene.store) is None
    assert await scene.keeper.keep() == ""
    assert completed_generation(scene.store) == 2


async def test_marker_whose_sync_fails_loses_neither_generation(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut could bring back the old marker until a new one is written and synced."""
    await scene.keeper.keep()
    scene.handle_message()
    sync = atomic_write.sync

    def fail(path: Path) -> None:
        if path == scene.store.folder:
            raise OSError(5, "Input/output error")
        sync(path)

    with monkeypatch.context() as bad:
        bad.setattr(atomic_write, "sync", fail)
        for _ in range(2):
            assert "Input/output error" in await scene.keeper.keep()
    assert completed_generation(scene.store) == 2
    assert [problem_of_completed(scene.store, ACTORS, number) for number in (1, 2)] == [None] * 2
    scene.stages.errors["tracker"] = "is busy"
    assert "is busy" in await scene.keeper.keep()
    assert problem_of_completed(scene.store, ACTORS, 2) is None
    assert scene.stages.kept[-1] == ("mapper", 3, 2)


async def test_unexpected_error_does_not_end_the_task(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(generations, "KEEP_EVERY_S", 0.001)
    scene.stages.errors["mapper"] = RuntimeError("can't start new thread")
    task = asyncio.create_task(scene.keeper.run())
    await eventually(lambda: scene.keeper._failures > 2)
    assert [r.levelname for r in caplog.records if r.exc_info] == ["ERROR"], "one traceback"
    scene.stages.errors.clear()
    await eventually(lambda: completed_generation(scene.store) is not None)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_failures_in_a_row_are_logged_once(
    scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    scene.stages.errors["tracker"] = "is busy"
    for _ in range(2):
        caplog.clear()
        for _ in range(2 * FAILURES_TO_LOG):
            await scene.keeper.keep()
        (warning,) = (r for r in caplog.records if r.levelno == logging.WARNING)
        assert "tracker is busy" in warning.getMessage()
        scene.stages.errors.clear()
        await scene.keeper.keep(is_forced=True)
        scene.stages.errors["tracker"] = "is busy"
        scene.handle_message()


async def test_age_grows_only_while_messages_are_handled_and_not_kept(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(generations, "time", SimpleNamespace(monotonic=lambda: now_s))
    await scene.keeper.keep()
    now_s += 50
    await scene.keeper.keep()
    assert scene.keeper.age_s() == 0, "no message was handled since"
    scene.handle_message()
    scene.stages.errors["tracker"] = "is busy"
    now_s += 50
    await scene.keeper.keep()
    assert scene.keeper.age_s() == 50
    scene.stages.errors.clear()
    await scene.keeper.keep()
    assert scene.keeper.age_s() == 0


async def test_closed_keeper_closes_its_publisher(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[MemoryPublisher] = []
    monkeypatch.setattr(MemoryPublisher, "close", lambda own: closed.append(own))
    scene.keeper.close()
    assert len(closed) == 1
