"""Small actor with failures, lagging state and credit, and recordings of its runs."""

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.recordings.recorder import Recorder
from ldo_service.recordings.recording import JournalFile, new_path, recorded_actors
from ldo_service.recordings.replay import ReplayReport, replay
from ldo_service.runtime import Actor, In, Lossless, Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import Message
from ldo_service.storage.state_store import FolderStore, State
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import (
    DOUBLES,
    NUMBERS,
    PIECES,
    QUICK,
    Double,
    Number,
    Piece,
    eventually,
    number,
    running,
    send,
)

FAILING_VALUE = 13


class Tally(Actor):
    """An actor that sums up numbers, fails at 13 and sends a piece while it has credit.

    It updates its state only every third step, so a restored actor lags behind the previous one.
    """

    name = "tally"
    inputs = (In(NUMBERS, Lossless(4)),)
    outputs = (Out(DOUBLES), Out(PIECES, is_nonblocking=True))

    def __init__(self, bias: int = 0) -> None:
        super().__init__()
        self._sum, self._steps, self._saved = bias, 0, {}

    def handle(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Number)
        self._sum += message.value
        self._steps += 1
        if message.value == FAILING_VALUE:
            raise ValueError("failing value")
        yield Double(stamp_ns=message.stamp_ns, value=self._sum)
        if self.has_credit(PIECES):
            yield Piece(stamp_ns=message.stamp_ns, version=self._sum, part=0, parts=1)

    def on_stop(self) -> Iterator[Message]:
        yield Double(stamp_ns=0, value=-self._sum)

    def snapshot(self) -> State:
        if self._steps % 3 == 0:
            self._saved = {"sum": self._sum}
        return self._saved

    def restore(self, state: State) -> None:
        self._sum = state["sum"]


async def run_recorded(
    folder: Path,
    values: Sequence[int],
    *,
    make: Callable[[], Actor] = Tally,
    expected: Mapping[str, frozenset[str]] = {},
    config: RecordConfig | None = None,
    before_each: Callable[[Recorder, int], None] = lambda _recorder, _value: None,
    is_killed: bool = False,
    wait_s: float = 0.0,
) -> Stage:
    """Run and record an actor that handles the values one by one, and return its stage.

    `before_each` is called before each value. A killed actor publishes no final messages. After
    each value, the actor has `wait_s` seconds without messages.
    """
    recording = folder / "recording"
    recording.mkdir(exist_ok=True)
    epoch = 1 + len(list(recording.iterdir()))  # Each run has a new source.
    recorder = Recorder(
        new_path(recording, make().name), {"robot": "test"}, config or RecordConfig()
    )
    transport = MemoryTransport()
    stage = Stage(
        make,
        transport,
        config=QUICK,
        store=FolderStore(folder / "state"),
        expected=expected,
        journal=recorder,
    )
    numbers = Outlet(Out(NUMBERS), "source", epoch, transport, (stage.name,))
    async with running(stage) as (task,):
        for done, value in enumerate(values, 1):
            before_each(recorder, value)
            await send(numbers, number(value))
            await eventually(
                lambda n=done: stage.health().steps + stage.health().dead_lettered == n
            )
            await asyncio.sleep(wait_s)
        if not is_killed:
            stage.drain()
            await task
    return stage


def files(folder: Path, actor: str = "tally") -> list[JournalFile]:
    return [JournalFile(path) for path in recorded_actors(folder / "recording")[actor]]


def replayed(folder: Path, make: Callable[[], Actor] = Tally) -> ReplayReport:
    return replay("tally", files(folder), lambda _about: make())


def recorded(folder: Path, values: Sequence[int], **options: Any) -> Path:
    """Record one run and return its file."""
    asyncio.run(run_recorded(folder, values, **options))
    return recorded_actors(folder / "recording")["tally"][-1]
