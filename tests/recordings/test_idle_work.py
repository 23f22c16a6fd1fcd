"""Tests of work while no message arrives, recorded, restored and replayed."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

from ldo_service.runtime.actor import Actor
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.schemas import Message
from ldo_service.storage.state_store import FolderStore
from tests.recordings.journal_helpers import Tally, files, replayed, run_recorded
from tests.runtime.fake_actors import Double, Number


class IdleTally(Tally):
    """Tally that adds 1 in each idle step.

    A number n below 10 allows n idle steps, and a larger number allows none.
    """

    idle_after_s = 0.001
    lags = True

    def __init__(self) -> None:
        super().__init__()
        self.left = 0

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self.left = message.value if message.value < 10 else 0
        yield from super().handle(message)

    def has_idle_work(self) -> bool:
        return self.left > 0

    def on_idle(self) -> Iterator[Message]:
        self.left -= 1
        self._sum += 1
        yield Double(stamp_ns=0, value=1000 + self._sum)

    def restore(self, state) -> None:
        super().restore(state)
        self.left = 0


class FailingIdly(IdleTally):
    def on_idle(self) -> Iterator[Message]:
        yield from super().on_idle()
        if self.left == 1:
            raise ValueError("failing idle work")


def run(folder: Path, values: list[int], make: type[Actor] = IdleTally, **options) -> None:
    async def run_and_wait() -> None:
        await run_recorded(folder, values, make=make, wait_s=0.3, **options)

    asyncio.run(run_and_wait())


def idle_steps(folder: Path) -> int:
    steps = [entry for file in files(folder) for entry in file.entries()]
    return sum(getattr(step, "kind", "") == "idle" for step in steps)


def test_idle_work_is_done_between_messages_and_replayed(tmp_path: Path) -> None:
    run(tmp_path, [3, 0, 2])
    assert idle_steps(tmp_path) == 5
    report = replayed(tmp_path, IdleTally)
    report.verify()
    assert report.steps == 3 + 5 + 1


def test_logged_idle_work_is_part_of_a_restored_state(tmp_path: Path) -> None:
    """The actor saves every third message; the steps since are handled again."""
    run(tmp_path, [0, 0, 100, 4], is_killed=True)
    past = RestoredState.of(FolderStore(tmp_path / "state").load("tally"))
    assert [one.topic for one in past.taken] == ["test/number", "", "", "", ""]
    run(tmp_path, [5])
    report = replayed(tmp_path, IdleTally)
    report.verify()
    assert report.restored == 1


def test_failed_idle_work_restores_the_actor_and_waits_for_the_next_message(
    tmp_path: Path,
) -> None:
    run(tmp_path, [3, 0], make=FailingIdly)
    report = replayed(tmp_path, FailingIdly)
    report.verify()
    assert report.failures == report.failures_repeated == 1
    assert report.taken["test/number"] == 2
