"""Tests of the control command: one answer for the whole service, also if an actor fails."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldo_service.runtime import Actor, In, Latest, Out, control
from ldo_service.runtime.control import Control, ControlError
from ldo_service.runtime.generations import GenerationKeeper
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import CommandSender
from ldo_service.schemas import ControlAnswer, ControlRequest, Health, Message, decode, encode
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import StateStore
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import (
    LATEST_NUMBER,
    NUMBERS,
    QUICK,
    Collector,
    Number,
    eventually,
    number,
    running,
)


class Source(Actor):
    name = "source"
    inputs = (In(LATEST_NUMBER, Latest(4)),)
    outputs = (Out(NUMBERS),)

    def handle(self, message: Message):
        assert isinstance(message, Number)
        yield message


class FullStore(MemoryStore):
    def save(self, actor: str, state, unsynced=()) -> None:  # noqa: ARG002
        raise OSError("disk full")


class LockedStore(MemoryStore):
    """A store that cannot delete states while `is_locked`."""

    is_locked = True

    def delete(self, actor: str) -> None:
        if self.is_locked:
            raise OSError("read-only file system")
        super().delete(actor)


class Scene:
    """A source, a collector and the control of their service."""

    def __init__(
        self,
        store: StateStore | None = None,
        timeout_s: float = 5.0,
        reset_marker: Path | None = None,
        pause_marker: Path | None = None,
        generations: GenerationKeeper | None = None,
        actors: tuple[str, ...] = ("source", "collector"),
    ) -> None:
        self._actors = actors
        self._markers = reset_marker, pause_marker, generations
        self.transport, self.seen = MemoryTransport(), []
        self.source = Stage(
            Source, self.transport, config=QUICK, store=store, starts_paused=self.has_marker
        )
        self.collector = Stage(lambda: Collector(self.seen), self.transport, config=QUICK)
        self._timeout_s = timeout_s

    @asynccontextmanager
    async def started(self) -> AsyncIterator[None]:
        async with running(self.source, self.collector):
            self.control = Control(
                *(self.transport, self._actors, ("source",), "here", self._timeout_s),
                *self._markers,
            )
            yield

    def has_marker(self) -> bool:
        return any(marker is not None and marker.exists() for marker in self._markers[:2])

    async def request(self, verb: str) -> ControlAnswer:
        body = encode(ControlRequest(stamp_ns=7, command=verb))
        return decode(await self.control.answer(body), ControlAnswer)

    def send(self, *values: int) -> None:
        for value in values:
            self.transport.deliver(LATEST_NUMBER.name, b"", encode(number(value)))

    def health(self) -> tuple[Health, Health]:
        return self.source.health(), self.collector.health()


async def test_frames_are_dropped_and_counted_while_paused() -> None:
    scene = Scene()
    async with scene.started():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])
        assert (await scene.request("pause")).ok
        scene.send(2, 3)
        assert (await scene.request("resume")).ok
        scene.send(4)
        await eventually(lambda: scene.seen == [1, 4])
        assert scene.health()[0].inputs[0].dropped_paused == 2


async def test_reset_starts_new_epochs_and_stream_continues() -> None:
    scene = Scene()
    async with scene.started():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])
        before = [health.epoch for health in scene.health()]
        answer = await scene.request("reset")
        assert (answer.ok, answer.stamp_ns) == (True, 7)
        assert all(health.epoch != old for health, old in zip(scene.health(), before, strict=True))
        scene.send(2)
        await eventually(lambda: scene.seen == [1, 2])


async def test_service_stays_paused_after_reset() -> None:
    scene = Scene()
    async with scene.started():
        await scene.request("pause")
        assert "stay paused" in (await scene.request("reset")).message
        source, collector = scene.health()
        assert (source.paused, collector.paused) == (True, False)


async def test_failed_save_names_the_actor() -> None:
    scene = Scene(store=FullStore())
    async with scene.started():
        answer = await scene.request("save")
        assert not answer.ok
        assert "source OSError: disk full" in answer.message


async def test_reset_names_unresponsive_actor_and_resumes_the_others() -> None:
    scene = Scene(timeout_s=0.05)
    async with scene.started():
        scene.control._actors = ("source", "absent", "collector")
        answer = await scene.request("reset")
        assert not answer.ok
        assert "absent did not answer" in answer.message
        assert not any(health.paused for health in scene.health())


async def test_unknown_command_is_answered_with_the_valid_ones() -> None:
    scene = Scene()
    async with scene.started():
        answer = await scene.request("localize-only")
        assert not answer.ok
        assert "pause, resume, save, reset" in answer.message


async def test_malformed_request_is_answered_with_an_error() -> None:
    scene = Scene()
    async with scene.started():
        for body in (b"", b"\xc1", encode(number(1))):
            answer = decode(await scene.control.answer(body), ControlAnswer)
            assert not answer.ok
            assert "malformed ControlRequest" in answer.message


async def test_paused_service_is_paused_after_a_restart_until_it_is_resumed(
    tmp_path: Path,
) -> None:
    scene = Scene(pause_marker=tmp_path / "paused")
    async with scene.started():
        assert (await scene.request("pause")).ok
    scene = Scene(pause_marker=tmp_path / "paused")
    async with scene.started():
        await eventually(lambda: scene.source.health().paused)
        assert (await scene.request("resume")).ok
    scene = Scene(pause_marker=tmp_path / "paused")
    async with scene.started():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])


async def test_paused_service_takes_no_frame_before_the_control_has_connected(
    tmp_path: Path,
) -> None:
    marker = tmp_path / "paused"
    marker.touch()
    scene = Scene(pause_marker=marker)
    async with running(scene.source, scene.collector):
        assert scene.source.health().paused
        scene.send(1, 2)
        await eventually(lambda: scene.source.health().inputs[0].dropped_paused == 2)
        assert scene.seen == []


async def test_marker_that_cannot_be_removed_pauses_no_restarted_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    scene = Scene(pause_marker=tmp_path / "paused")
    async with scene.started():
        assert (await scene.request("pause")).ok
        monkeypatch.setattr(Path, "unlink", fail)
        answer = await scene.request("resume")
        assert answer.ok
        assert "A restart pauses the service again" in answer.message
        assert scene.has_marker()
        restarted = Stage(Source, scene.transport, config=QUICK, starts_paused=scene.has_marker)
        async with running(restarted):
            await eventually(lambda: not restarted.health().paused)


async def test_pause_that_cannot_be_written_says_that_a_restart_resumes(tmp_path: Path) -> None:
    scene = Scene(pause_marker=tmp_path / "absent" / "paused")
    async with scene.started():
        answer = await scene.request("pause")
        assert answer.ok
        assert "A restart resumes the service too" in answer.message
        assert scene.source.health().paused


async def test_restarted_source_is_paused_again() -> None:
    scene = Scene()
    async with scene.started():
        await scene.request("pause")
    restarted = Stage(Source, scene.transport, config=QUICK)
    async with running(restarted):
        await eventually(lambda: restarted.health().paused)


async def test_incomplete_reset_holds_all_actors_until_it_is_repeated(tmp_path: Path) -> None:
    store, marker = LockedStore(), tmp_path / "reset"
    scene = Scene(store, reset_marker=marker)
    async with scene.started():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])
        answer = await scene.request("reset")
        assert not answer.ok
        assert "source OSError: read-only" in answer.message
        assert marker.exists(), "the next start has to complete the reset"
        source, collector = scene.health()
        assert (source.paused, collector.paused) == (True, True)
        refused = await scene.request("resume")
        assert "the last reset is not complete" in refused.message
        store.is_locked = False
        assert (await scene.request("reset")).ok
        assert not marker.exists()
        scene.send(2)
        await eventually(lambda: scene.seen == [1, 2])


async def test_actor_that_is_reset_before_its_producer_takes_nothing_of_the_old_run() -> None:
    scene = Scene(actors=("collector", "source"))
    async with scene.started():
        assert await scene.control._sender.send("pause", "collector", 5.0) == ""
        scene.send(1)
        await eventually(lambda: scene.source.health().steps == 1)
        assert (await scene.request("reset")).ok
        scene.send(2)
        await eventually(lambda: scene.seen)
        assert scene.seen == [2]


async def test_any_restarted_actor_is_paused_while_a_reset_is_not_complete(tmp_path: Path) -> None:
    scene = Scene(LockedStore(), reset_marker=tmp_path / "reset")
    async with scene.started():
        assert not (await scene.request("reset")).ok
        restarted = Stage(lambda: Collector([]), scene.transport, config=QUICK)
        async with running(restarted):
            await eventually(lambda: restarted.health().paused)


async def test_restarted_actor_is_reset_although_no_consumer_takes_its_saved_outputs() -> None:
    """During a reset, its consumer connects only when all actors are reset."""
    store, transport = MemoryStore(), MemoryTransport()
    required = {NUMBERS.name: frozenset({"collector"})}

    def source() -> Stage:
        return Stage(Source, transport, config=QUICK, store=store, expected=required)

    async with running(killed := source()):
        transport.deliver(LATEST_NUMBER.name, b"", encode(number(1)))
        await eventually(lambda: killed.health().outputs[0].backpressure_waits)
    async with running(source()):
        sender = CommandSender(transport)
        for what in ("pause", "reset"):
            assert await sender.send(what, "source", 5.0) == ""


async def test_reset_of_the_previous_process_is_completed(tmp_path: Path) -> None:
    marker = tmp_path / "reset"
    marker.touch()
    scene = Scene(reset_marker=marker)
    before = [health.epoch for health in scene.health()]
    async with scene.started():
        await eventually(lambda: not marker.exists())
        assert all(health.epoch != old for health, old in zip(scene.health(), before, strict=True))
        await eventually(lambda: not scene.health()[0].paused)


async def test_reset_marker_that_cannot_be_removed_holds_all_actors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next start would delete a map that is made while the marker exists."""

    def fail(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    scene = Scene(reset_marker=tmp_path / "reset")
    async with scene.started():
        for method in ("unlink", "sync"):
            with monkeypatch.context() as read_only:
                read_only.setattr(Path if method == "unlink" else control, method, fail)
                answer = await scene.request("reset")
            assert "cannot be removed: Read-only" in answer.message
            assert [health.paused for health in scene.health()] == [True, True]
        assert (await scene.request("reset")).ok
        assert not any(health.paused for health in scene.health())


async def test_reset_of_the_previous_process_is_completed_after_any_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(control, "COMPLETE_AGAIN_S", 0.001)
    errors: list[Exception] = [ControlError("source is busy"), RuntimeError("no thread")]
    reset = Control._reset

    async def fail_at_first(own: Control) -> str:
        if errors:
            raise errors.pop(0)
        return await reset(own)

    monkeypatch.setattr(Control, "_reset", fail_at_first)
    marker = tmp_path / "reset"
    marker.touch()
    scene = Scene(reset_marker=marker)
    async with scene.started():
        await eventually(lambda: not marker.exists())
    assert "reset: source is busy The service tries again." in caplog.text


async def test_reset_without_a_marker_on_the_disk_is_refused(tmp_path: Path) -> None:
    scene = Scene(reset_marker=tmp_path / "absent" / "reset")
    async with scene.started():
        before = [health.epoch for health in scene.health()]
        answer = await scene.request("reset")
        assert "no actor was reset" in answer.message
        assert [health.epoch for health in scene.health()] == before
        assert not any(health.paused for health in scene.health())


class Generations(GenerationKeeper):
    """Keeper that fails as often as a test wants."""

    def __init__(self, failures: int) -> None:
        self.failures, self.attempts = failures, 0
        self.lock = asyncio.Lock()

    async def keep(self, *, is_forced: bool = False) -> str:
        assert is_forced, "the empty states may have the names of the files before"
        self.attempts += 1
        return "disk full" if self.attempts <= self.failures else ""


@pytest.mark.parametrize(("failures", "is_kept"), [(0, True), (20, True), (10**9, False)])
async def test_reset_is_complete_when_the_empty_states_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failures: int, is_kept: bool
) -> None:
    monkeypatch.setattr(control, "KEEP_AGAIN_S", 0.001)
    if not is_kept:
        monkeypatch.setattr(control, "KEEP_FOR_S", 0.01)
    generations, marker = Generations(failures), tmp_path / "reset"
    scene = Scene(reset_marker=marker, generations=generations)
    async with scene.started():
        answer = await scene.request("reset")
        assert answer.ok is is_kept
        assert marker.exists() is not is_kept, "the next start has to complete the reset"
        assert scene.source.health().paused is not is_kept
        if not is_kept:
            assert "A power cut could bring back the old map" in answer.message
            generations.failures = 0
            assert (await scene.request("reset")).ok
            assert not marker.exists()


async def test_actor_that_starts_during_a_command_executes_it_although_it_is_paused_too() -> None:
    scene = Scene(actors=("source",))
    control_ = Control(scene.transport, ("source",), ("source",), "here", 5.0)
    scene.control = control_
    async with running(scene.source):
        assert (await scene.request("pause")).ok
    saving = asyncio.create_task(scene.request("save"))
    await asyncio.sleep(0.05)
    assert not saving.done()
    restarted = Stage(Source, scene.transport, config=QUICK)
    async with running(restarted):
        answer = await saving
        assert answer.ok, answer.message
        await eventually(lambda: restarted.health().paused)
        assert (await scene.request("resume")).ok
        assert not restarted.health().paused
    control_.close()
