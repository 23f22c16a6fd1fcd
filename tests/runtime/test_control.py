"""One answer for the whole service, whatever is asked and whoever does not obey."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.stage_commands import Control
from ldo_service.schemas import ControlAnswer, ControlRequest, Health, Message, decode, encode
from ldo_service.storage.state_store import MemoryStore, StateStore
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


class Unsaveable(MemoryStore):
    def save(self, actor: str, state) -> None:  # noqa: ARG002
        raise OSError("disk full")


class Scene:
    """A source and a collector, and their service's control."""

    def __init__(self, store: StateStore | None = None, timeout_s: float = 5.0) -> None:
        self.transport, self.seen = MemoryTransport(), []
        self.source = Stage(Source, self.transport, config=QUICK, store=store)
        self.collector = Stage(lambda: Collector(self.seen), self.transport, config=QUICK)
        self._timeout_s = timeout_s

    @asynccontextmanager
    async def played(self) -> AsyncIterator[None]:
        async with running(self.source, self.collector):
            actors = ("source", "collector")
            self.control = Control(self.transport, actors, ("source",), "here", self._timeout_s)
            yield

    async def ask(self, verb: str) -> ControlAnswer:
        request = encode(ControlRequest(stamp_ns=7, command=verb))
        return decode(await self.control.answer(request), ControlAnswer)

    def send(self, *values: int) -> None:
        for value in values:
            self.transport.deliver(LATEST_NUMBER.name, b"", encode(number(value)))

    def health(self) -> tuple[Health, Health]:
        return self.source.health(), self.collector.health()


async def test_paused_frames_are_left_out_until_resume() -> None:
    scene = Scene()
    async with scene.played():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])
        assert (await scene.ask("pause")).ok
        scene.send(2, 3)
        assert (await scene.ask("resume")).ok
        scene.send(4)
        await eventually(lambda: scene.seen == [1, 4])
        assert scene.health()[0].inputs[0].dropped_paused == 2


async def test_a_reset_begins_every_epoch_anew_and_the_stream_goes_on() -> None:
    scene = Scene()
    async with scene.played():
        scene.send(1)
        await eventually(lambda: scene.seen == [1])
        before = [health.epoch for health in scene.health()]
        answer = await scene.ask("reset")
        assert (answer.ok, answer.stamp_ns) == (True, 7)
        assert all(health.epoch != old for health, old in zip(scene.health(), before, strict=True))
        scene.send(2)
        await eventually(lambda: scene.seen == [1, 2])


async def test_a_reset_while_paused_stays_paused() -> None:
    scene = Scene()
    async with scene.played():
        await scene.ask("pause")
        assert "stay paused" in (await scene.ask("reset")).message
        source, collector = scene.health()
        assert (source.paused, collector.paused) == (True, False)


async def test_an_actor_that_cannot_save_is_named() -> None:
    scene = Scene(store=Unsaveable())
    async with scene.played():
        answer = await scene.ask("save")
        assert not answer.ok
        assert "source OSError: disk full" in answer.message


async def test_an_actor_that_does_not_answer_is_named_and_the_others_go_on() -> None:
    scene = Scene(timeout_s=0.05)
    async with scene.played():
        scene.control._actors = ("source", "absent", "collector")
        answer = await scene.ask("reset")
        assert not answer.ok
        assert "absent did not answer" in answer.message
        assert not any(health.paused for health in scene.health())


async def test_another_verb_is_answered_with_those_there_are() -> None:
    scene = Scene()
    async with scene.played():
        answer = await scene.ask("localise-only")
        assert not answer.ok
        assert "pause, resume, save, reset" in answer.message


async def test_bytes_that_are_no_request_are_answered_all_the_same() -> None:
    scene = Scene()
    async with scene.played():
        for body in (b"", b"\xc1", encode(number(1))):
            answer = decode(await scene.control.answer(body), ControlAnswer)
            assert not answer.ok
            assert "malformed ControlRequest" in answer.message


async def test_a_source_that_was_restarted_is_told_of_the_pause() -> None:
    scene = Scene()
    async with scene.played():
        await scene.ask("pause")
    successor = Stage(Source, scene.transport, config=QUICK)
    async with running(successor):
        await eventually(lambda: successor.health().paused)
