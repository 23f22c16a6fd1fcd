"""Tests of replay: a recorded run is reproduced, or the first difference is named."""

import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from ldo_service.errors import DataError, ReplayDiverged
from ldo_service.recordings import mcap_file
from ldo_service.recordings.mcap_file import McapIndex, RecordConfig
from ldo_service.runtime.mailbox import Mailbox
from ldo_service.schemas import Message
from ldo_service.storage.state_store import State
from tests.runtime.fake_actors import DOUBLES, NUMBERS, PIECES, Double

from .journal_helpers import FAILING_VALUE, Tally, files, recorded, replayed
from .test_recorder import BusyDisk

VALUES = [5, 1, 4, 1, 5, 9, 2, 6]


def test_recorded_run_replays(tmp_path: Path) -> None:
    recorded(tmp_path, VALUES)
    result = replayed(tmp_path)
    result.verify()
    assert (result.starts, result.steps, result.failures) == (1, len(VALUES) + 1, 0)
    assert result.taken == {NUMBERS.name: len(VALUES)}
    assert result.made == {DOUBLES.name: len(VALUES) + 1, PIECES.name: len(VALUES)}
    assert result.notes == []


def test_replayed_actor_sees_the_recorded_credits(tmp_path: Path) -> None:
    recorded(tmp_path, VALUES, expected={PIECES.name: frozenset({"absent"})})
    result = replayed(tmp_path)
    result.verify()
    assert result.made == {DOUBLES.name: len(VALUES) + 1}


class BacklogTally(Tally):
    """An actor that publishes the number of queued messages."""

    def handle(self, message: Message) -> Iterator[Message]:
        yield Double(stamp_ns=message.stamp_ns, value=self.situation.backlog.get(NUMBERS, -1))


def test_replayed_actor_sees_the_recorded_backlog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = iter(range(100))
    monkeypatch.setattr(Mailbox, "waiting", lambda _self: {NUMBERS: next(counts)})
    recorded(tmp_path, VALUES, make=BacklogTally)
    assert next(counts) > len(VALUES)
    replayed(tmp_path, BacklogTally).verify()


def test_failures_and_restored_states_are_replayed(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2, 3, 4, FAILING_VALUE, 5, 6, FAILING_VALUE, 7])
    result = replayed(tmp_path)
    result.verify()
    assert (result.failures, result.failures_repeated, result.dead_lettered) == (4, 4, 2)
    assert (result.starts, result.restored) == (5, 4)


def test_failure_that_does_not_repeat_is_a_note_not_a_difference(tmp_path: Path) -> None:
    class NotFailing(Tally):
        def handle(self, message: Message) -> Iterator[Message]:
            try:
                yield from super().handle(message)
            except ValueError:
                return

    recorded(tmp_path, [1, 2, 3, FAILING_VALUE, 4])
    result = replayed(tmp_path, NotFailing)
    result.verify()
    assert (result.failures, result.failures_repeated) == (2, 0)
    assert "ValueError('failing value')" in result.notes[0]


def test_killed_actor_and_its_restart_replay(tmp_path: Path) -> None:
    first = recorded(tmp_path, [1, 2, 3, 4, 5], is_killed=True)
    last = McapIndex(first).locations[-1]
    # The last step is cut in half.
    first.write_bytes(first.read_bytes()[: last.start + last.size // 2])
    recorded(tmp_path, [5, 6, 7])
    assert [file.is_whole for file in files(tmp_path)] == [False, True]
    result = replayed(tmp_path)
    result.verify()
    assert (result.starts, result.restored) == (2, 1)
    assert "tally.mcap was cut off" in result.notes[0]
    assert "test/number (stamp 5 ns)" in result.notes[0]
    assert result.steps == 4 + 4


def test_truncated_file_replays_up_to_its_last_complete_step(tmp_path: Path) -> None:
    path = recorded(tmp_path, [1, 2, FAILING_VALUE, 3, 4])
    whole = path.read_bytes()
    lengths = sorted(random.Random(1).sample(range(8, len(whole)), 60))
    counts = []
    for length in lengths:
        path.write_bytes(whole[:length])
        result = replayed(tmp_path)
        result.verify()
        counts.append(result.steps)
    assert counts == sorted(counts)
    assert counts[0] < 2
    assert counts[-1] == 8


def test_divergence_names_actor_step_and_output(tmp_path: Path) -> None:
    class Changed(Tally):
        def handle(self, message: Message) -> Iterator[Message]:
            for made in super().handle(message):
                is_large = isinstance(made, Double) and made.value > 10
                yield Double(stamp_ns=0, value=0) if is_large else made

    recorded(tmp_path, VALUES)
    with pytest.raises(ReplayDiverged) as caught:
        replayed(tmp_path, Changed).verify()
    error = caught.value
    assert error.exit_code == 5
    assert error.actor == "tally"
    assert error.step == "step 3 (tally.mcap, test/number #3)"
    assert "output 1 of 2 differs: test/double" in error.what
    assert error.recorded in str(error)
    assert error.replayed in str(error)
    assert error.recorded != error.replayed


def test_unrestorable_recorded_state_is_a_difference(tmp_path: Path) -> None:
    class Changed(Tally):
        def restore(self, state: State) -> None:
            self._sum = state["total"]

    recorded(tmp_path, [1, 2, 3, FAILING_VALUE])
    with pytest.raises(ReplayDiverged, match=r"start before step 4 .*rejected \(KeyError"):
        replayed(tmp_path, Changed).verify()


def test_additional_output_is_a_difference(tmp_path: Path) -> None:
    class AdditionalOutput(Tally):
        def on_stop(self) -> Iterator[Message]:
            yield from super().on_stop()
            yield Double(stamp_ns=0, value=0)

    recorded(tmp_path, [1])
    with pytest.raises(ReplayDiverged, match="1 outputs, now 2"):
        replayed(tmp_path, AdditionalOutput).verify()


def test_step_that_fails_only_in_replay_is_a_difference(tmp_path: Path) -> None:
    class AlwaysFailing(Tally):
        def handle(self, message: Message) -> Iterator[Message]:
            raise KeyError("new")
            yield from super().handle(message)

    recorded(tmp_path, [1])
    with pytest.raises(ReplayDiverged, match=r"step 0 .* a failure \(KeyError"):
        replayed(tmp_path, AlwaysFailing).verify()


def test_hidden_input_is_detected(tmp_path: Path) -> None:
    """The result of the actor depends on something other than its messages."""
    recorded(tmp_path, VALUES, make=lambda: Tally(bias=0))
    with pytest.raises(ReplayDiverged, match="step 0"):
        replayed(tmp_path, lambda: Tally(bias=1)).verify()


def test_flipped_bit_in_a_message_is_detected(tmp_path: Path) -> None:
    path = recorded(tmp_path, VALUES)
    content = bytearray(path.read_bytes())
    nine = content.index(b"\xa5value\x09") + 6  # Message 5.
    content[nine] ^= 1
    path.write_bytes(content)
    with pytest.raises(ReplayDiverged, match=r"step 5 .*checksum of its input"):
        replayed(tmp_path).verify()


def test_actor_that_talks_outside_is_not_replayed(tmp_path: Path) -> None:
    class Outside(Tally):
        talks_outside = True

        def handle(self, message: Message) -> Iterator[Message]:
            pytest.fail(f"asked about {message}")
            yield message

    recorded(tmp_path, VALUES)
    result = replayed(tmp_path, Outside)
    result.verify()
    assert result.made == {}


# --- gaps -----------------------------------------------------------------------------------------
def test_replay_ends_at_a_gap_and_does_not_pass(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    recorded(tmp_path, range(20, 60), config=tiny, before_each=BusyDisk(25, 50))
    result = replayed(tmp_path)
    assert result.difference is None
    assert 5 <= result.steps < 20
    with pytest.raises(DataError, match=r"has a gap before step \d+: the disk was too slow"):
        result.verify()


def test_replay_resumes_at_a_restart_after_a_gap(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    values = [*range(20, 60), FAILING_VALUE, 60, 61]
    recorded(tmp_path, values, config=tiny, before_each=BusyDisk(25, 50))
    result = replayed(tmp_path)
    assert result.difference is None
    assert (result.starts, result.failures, result.dead_lettered) == (3, 1, 1)
    assert not result.is_complete


def test_recording_that_ended_at_its_limit_replays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "CHECK_EVERY_BYTES", 100)
    recorded(tmp_path, range(20, 60), config=RecordConfig(max_gb=6e-6))
    result = replayed(tmp_path)
    result.verify()
    assert 0 < result.steps < 40
    assert result.notes == [f"tally.mcap ends at its size limit, before step {result.steps}."]


def test_missing_message_raises_data_error(tmp_path: Path) -> None:
    path = recorded(tmp_path, VALUES)
    rewrite(path, CompressionType.NONE, leave_out=(NUMBERS.name, 3))
    with pytest.raises(DataError, match="input of step 3 is missing"):
        replayed(tmp_path)


# --- files ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("compression", list(CompressionType)[::2], ids=lambda c: c.name)
def test_copy_written_by_another_program_replays(
    tmp_path: Path, compression: CompressionType
) -> None:
    """The MCAP library and its tools write chunks by default, compressed or not."""
    path = recorded(tmp_path, [*VALUES, FAILING_VALUE, 3])
    rewrite(path, compression)
    result = replayed(tmp_path)
    result.verify()
    assert result.steps == len(VALUES) + 5
    assert result.notes == []


def rewrite(
    path: Path, compression: CompressionType, leave_out: tuple[str, int] | None = None
) -> None:
    copy = path.with_suffix(".new")
    with path.open("rb") as source, copy.open("wb") as target:
        writer = Writer(target, chunk_size=200, compression=compression)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if (channel.topic, message.sequence) == leave_out:
                continue
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
            writer.add_message(
                channels[channel.topic],
                *(message.log_time, message.data, message.publish_time, message.sequence),
            )
        writer.finish()
    copy.rename(path)


@pytest.mark.parametrize("compression", list(CompressionType)[::2], ids=lambda c: c.name)
def test_damage_anywhere_is_a_data_error_or_a_difference(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = recorded(tmp_path, [1, 2, 3, FAILING_VALUE, 4])
    rewrite(path, compression)
    whole, rng, detected = path.read_bytes(), random.Random(2), 0
    for place in rng.sample(range(len(whole)), 300):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            replayed(tmp_path).verify()
        except (DataError, ReplayDiverged):
            detected += 1
    assert detected > 20


@pytest.mark.parametrize("content", [b"", b"not a recording at all", b"\x89MCAP0\r\n\x05\x01"])
def test_file_that_is_no_recording_raises_data_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "tally.mcap").write_bytes(content)
    if content.startswith(b"\x89"):
        assert replayed(tmp_path).steps == 0
    else:
        with pytest.raises(DataError, match="cannot be read as a recording"):
            files(tmp_path)
