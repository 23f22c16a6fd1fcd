"""Tests of the recorder: content of a recording, and disks that are slow or full."""

import asyncio
import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from threading import Event

import msgpack
import pytest
from mcap.reader import make_reader

from ldo_service.errors import ConfigError
from ldo_service.recordings import mcap_file
from ldo_service.recordings.mcap_file import RECORDING_VERSION, RecordConfig
from ldo_service.recordings.recorder import Recorder
from ldo_service.recordings.recording import (
    JournalFile,
    new_path,
    prepare_recording,
    recorded_actors,
)
from ldo_service.runtime import In, Latest
from ldo_service.runtime.journal import Gap, Started, StepRecord, checksum
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import encode
from ldo_service.transport.interface import MemoryTransport
from tests.runtime.fake_actors import (
    DOUBLES,
    LATEST_NUMBER,
    NUMBERS,
    PIECES,
    QUICK,
    eventually,
    number,
    running,
)

from .journal_helpers import FAILING_VALUE, Tally, files, recorded, run_recorded


def entries(folder: Path) -> list[Started | StepRecord | Gap]:
    return [entry for file in files(folder) for entry in file.entries()]


def steps(folder: Path) -> list[StepRecord]:
    return [entry for entry in entries(folder) if isinstance(entry, StepRecord)]


def test_recording_holds_every_step_in_order(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2, 3])
    found = entries(tmp_path)
    assert found[0] == Started(step=0, state=None)
    assert [step.kind for step in steps(tmp_path)] == ["done", "done", "done", "finished"]
    assert [step.step for step in steps(tmp_path)] == [0, 1, 2, 3]
    assert [step.seq for step in steps(tmp_path)[:3]] == [0, 1, 2]
    assert {(step.topic, step.source, step.epoch) for step in steps(tmp_path)[:3]} == {
        (NUMBERS.name, "source", 1)
    }


def test_step_lists_its_outputs_and_a_digest(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2])
    first, second, last = steps(tmp_path)
    assert [output.topic for output in first.outputs] == [DOUBLES.name, PIECES.name]
    assert [output.topic for output in last.outputs] == [DOUBLES.name]
    assert len({first.digest, second.digest, last.digest}) == 3


def test_recorded_message_equals_the_received_bytes(tmp_path: Path) -> None:
    recorded(tmp_path, [7])
    (file,), (step, _) = files(tmp_path), steps(tmp_path)
    body = file.taken(step)
    assert msgpack.unpackb(body) == {
        "type": "Number",
        "stamp_ns": 7,
        "value": 7,
        "region": "",
        "data": b"",
    }
    assert checksum(body) == step.checksum


def test_failed_message_is_stored_once_with_both_attempts(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2, 3, FAILING_VALUE, 4])
    kinds = [step.kind for step in steps(tmp_path)]
    assert kinds == ["done"] * 3 + ["failed", "failed", "dead_lettered", "done", "finished"]
    failed = steps(tmp_path)[3]
    assert failed.error == "ValueError('failing value')"
    assert failed.outputs == ()
    assert len(files(tmp_path)[0].messages) == 5
    starts = [entry for entry in entries(tmp_path) if isinstance(entry, Started)]
    assert [(start.step, start.state is None) for start in starts] == [
        (0, True),
        (4, False),
        (5, False),
    ]


def test_credits_of_each_step_are_recorded(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2], expected={PIECES.name: frozenset({"absent"})})
    assert [step.credits for step in steps(tmp_path)] == [{PIECES.name: 0}] * 3
    assert [output.topic for output in steps(tmp_path)[0].outputs] == [DOUBLES.name]


def test_finished_steps_are_in_the_file_before_it_is_closed(tmp_path: Path) -> None:
    """A killed process must leave its finished steps behind."""
    seen: list[int] = []

    def count_steps(recorder: Recorder, _value: int) -> None:
        recorder._writer.submit(int).result(10)  # Waits until the writer has caught up.
        seen.append(len(steps(tmp_path)))

    recorded(tmp_path, [1, 2, 3, 4], before_each=count_steps)
    assert seen == [0, 1, 2, 3]


def test_message_without_header_keeps_its_own_stamp(tmp_path: Path) -> None:
    """Other programs send messages without our header."""

    class LatestTally(Tally):
        inputs = (In(LATEST_NUMBER, Latest(4)),)

    async def run() -> None:
        transport = MemoryTransport()
        recorder = Recorder(tmp_path / "tally.mcap", {}, RecordConfig())
        stage = Stage(LatestTally, transport, config=QUICK, journal=recorder)
        async with running(stage):
            for stamp_ns in (100, 200):
                transport.deliver(LATEST_NUMBER.name, b"", encode(number(stamp_ns)))
            await eventually(lambda: stage.health().steps == 2)

    asyncio.run(run())
    assert [m.stamp_ns for m in JournalFile(tmp_path / "tally.mcap").messages] == [100, 200]


def test_recording_is_readable_with_the_mcap_library(tmp_path: Path) -> None:
    path = recorded(tmp_path, [5, 6])
    with path.open("rb") as stream:
        reader = make_reader(stream)
        found = list(reader.iter_messages())
        (about,) = reader.iter_metadata()
    assert about.metadata == {"robot": "test", "version": str(RECORDING_VERSION)}
    assert {channel.message_encoding for _, channel, _ in found} == {"msgpack"}
    for schema, _, message in found:
        assert schema is not None
        assert "$defs" in json.loads(schema.data)
        assert isinstance(msgpack.unpackb(message.data), dict)
    numbers = [message for _, channel, message in found if channel.topic == NUMBERS.name]
    assert [msgpack.unpackb(message.data)["value"] for message in numbers] == [5, 6]
    assert [message.publish_time for message in numbers] == [5, 6]
    times = [message.log_time for _, _, message in found]
    assert all(one < other for one, other in pairwise(times))


# --- slow and full disks --------------------------------------------------------------------------
class BusyDisk:
    """A disk that blocks the writer from one value to another."""

    def __init__(self, since: int, until: int) -> None:
        self._since, self._until, self._free = since, until, Event()

    def __call__(self, recorder: Recorder, value: int) -> None:
        if value == self._since:
            recorder._writer.submit(self._free.wait, 10)
        elif value == self._until:
            self._free.set()
            recorder._writer.submit(int).result(10)  # Waits until the writer has caught up.


def test_slow_disk_leaves_one_marked_and_logged_gap(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tiny = RecordConfig(queue_mb=0.012)  # Six small messages and their steps.
    recorded(tmp_path, range(1, 31), config=tiny, before_each=BusyDisk(5, 25))
    gaps = [entry for entry in entries(tmp_path) if isinstance(entry, Gap)]
    (gap,) = gaps
    assert gap.reason == "slow"
    assert 5 < gap.lost < 20
    assert len(steps(tmp_path)) == 31 - gap.lost
    assert caplog.text.count("the disk is too slow") == 1
    assert f"{gap.lost} messages were not recorded" in caplog.text


def test_actor_does_not_wait_for_the_disk(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    blocked = BusyDisk(1, until=40)
    # If the actor waited for the disk, `eventually` would fail.
    recorded(tmp_path, range(1, 41), config=tiny, before_each=blocked)


async def test_dropped_messages_are_counted_in_health(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    stage = await run_recorded(tmp_path, range(1, 31), config=tiny, before_each=BusyDisk(5, 25))
    metrics = stage.health().metrics
    (gap,) = [entry for entry in entries(tmp_path) if isinstance(entry, Gap)]
    assert metrics["journal_messages_dropped"] == gap.lost
    final_step = 1
    assert metrics["journal_steps"] == 30 - gap.lost + final_step


@contextmanager
def file_size_limit(bytes_: int) -> Iterator[None]:
    """Simulate a full disk: writing beyond the limit fails with an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_ends_the_recording_and_not_the_actor(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with file_size_limit(6000):
        path = recorded(tmp_path, range(20, 60))
    assert path.stat().st_size <= 6000
    assert 0 < len(steps(tmp_path)) < 40
    assert caplog.text.count("This recording ends here") == 1
    assert not files(tmp_path)[0].is_whole


def test_recorder_failure_ends_the_recording_and_not_the_actor(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def break_recorder(recorder: Recorder, value: int) -> None:
        if value == 3:
            recorder._submit(0, lambda: 1 // 0)  # type: ignore[arg-type]

    recorded(tmp_path, [1, 2, 3, 4, 5], before_each=break_recorder)
    assert len(steps(tmp_path)) == 2
    assert caplog.text.count("This recording ends here") == 1
    assert "ZeroDivisionError" in caplog.text


def test_recording_ends_at_its_size_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mcap_file, "CHECK_EVERY_BYTES", 100)
    recorded(tmp_path, range(20, 60), config=RecordConfig(max_gb=6e-6))
    last = entries(tmp_path)[-1]
    assert isinstance(last, Gap)
    assert last.reason == "limit"
    assert last.step == len(steps(tmp_path)) < 40
    assert caplog.text.count("recording.max_gb") == 1
    assert files(tmp_path)[0].is_whole


def test_recording_ends_on_a_nearly_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "CHECK_EVERY_BYTES", 100)
    recorded(tmp_path, range(20, 60), config=RecordConfig(min_free_gb=1e6))
    assert len(steps(tmp_path)) < 10


# --- files ----------------------------------------------------------------------------------------
def test_each_run_of_an_actor_has_a_numbered_file(tmp_path: Path) -> None:
    for _ in range(11):
        new_path(tmp_path, "mapper").touch()
    new_path(tmp_path, "tracker").touch()
    (tmp_path / "notes.txt").touch()
    names = {actor: [path.name for path in paths] for actor, paths in
             recorded_actors(tmp_path).items()}  # fmt: skip
    later = [f"mapper.{number}.mcap" for number in range(2, 12)]
    assert names == {"mapper": ["mapper.mcap", *later], "tracker": ["tracker.mcap"]}


def test_recording_continues_in_its_own_folder_and_in_no_other(tmp_path: Path) -> None:
    prepare_recording(tmp_path / "new")
    (tmp_path / "new" / "tracker.mcap").touch()
    prepare_recording(tmp_path / "new")
    assert new_path(tmp_path / "new", "tracker").name == "tracker.2.mcap"
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="is not empty and holds no recording"):
        prepare_recording(tmp_path)
    with pytest.raises(ConfigError, match="cannot be written"):
        prepare_recording(Path("/proc/nowhere"))


@pytest.mark.parametrize("field", ["max_gb", "queue_mb"])
def test_recording_of_size_zero_is_rejected(field: str) -> None:
    with pytest.raises(ConfigError):
        RecordConfig(**{field: 0})
