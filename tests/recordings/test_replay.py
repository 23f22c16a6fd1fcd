"""A recorded life, lived again: the same, or the first difference is named."""

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

from .journal_helpers import UNLUCKY, Tally, files, recorded, replayed
from .test_recorder import BusyDisk

VALUES = [5, 1, 4, 1, 5, 9, 2, 6]


def test_a_life_replays(tmp_path: Path) -> None:
    recorded(tmp_path, VALUES)
    result = replayed(tmp_path)
    result.verify()
    assert (result.starts, result.steps, result.failures) == (1, len(VALUES) + 1, 0)
    assert result.taken == {NUMBERS.name: len(VALUES)}
    assert result.made == {DOUBLES.name: len(VALUES) + 1, PIECES.name: len(VALUES)}
    assert result.notes == []


def test_the_room_of_the_time_is_what_the_actor_sees(tmp_path: Path) -> None:
    recorded(tmp_path, VALUES, expected={PIECES.name: frozenset({"absent"})})
    result = replayed(tmp_path)
    result.verify()
    assert result.made == {DOUBLES.name: len(VALUES) + 1}


class Counting(Tally):
    """Says how many numbers wait."""

    def handle(self, message: Message) -> Iterator[Message]:
        yield Double(stamp_ns=message.stamp_ns, value=self.situation.backlog.get(NUMBERS, -1))


def test_what_waited_at_the_time_is_what_the_actor_sees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = iter(range(100))
    monkeypatch.setattr(Mailbox, "waiting", lambda _self: {NUMBERS: next(counts)})
    recorded(tmp_path, VALUES, make=Counting)
    assert next(counts) > len(VALUES)
    replayed(tmp_path, Counting).verify()


def test_failures_and_the_states_after_them_are_lived_again(tmp_path: Path) -> None:
    recorded(tmp_path, [1, 2, 3, 4, UNLUCKY, 5, 6, UNLUCKY, 7])
    result = replayed(tmp_path)
    result.verify()
    assert (result.failures, result.failures_repeated, result.dead_lettered) == (4, 4, 2)
    assert (result.starts, result.restored) == (5, 4)


def test_a_failure_that_does_not_repeat_is_noted_and_no_difference(tmp_path: Path) -> None:
    class Fortunate(Tally):
        def handle(self, message: Message) -> Iterator[Message]:
            try:
                yield from super().handle(message)
            except ValueError:
                return

    recorded(tmp_path, [1, 2, 3, UNLUCKY, 4])
    result = replayed(tmp_path, Fortunate)
    result.verify()
    assert (result.failures, result.failures_repeated) == (2, 0)
    assert "ValueError('unlucky')" in result.notes[0]


def test_a_killed_actor_and_its_successor_replay(tmp_path: Path) -> None:
    first = recorded(tmp_path, [1, 2, 3, 4, 5], is_killed=True)
    last = McapIndex(first).places[-1]
    first.write_bytes(first.read_bytes()[: last.start + last.size // 2])  # half its last step
    recorded(tmp_path, [5, 6, 7])
    assert [file.is_whole for file in files(tmp_path)] == [False, True]
    result = replayed(tmp_path)
    result.verify()
    assert (result.starts, result.restored) == (2, 1)
    assert "tally.mcap was cut off" in result.notes[0]
    assert "test/number (stamp 5 ns)" in result.notes[0]
    assert result.steps == 4 + 4


def test_a_file_that_was_cut_anywhere_replays_up_to_its_last_whole_step(tmp_path: Path) -> None:
    path = recorded(tmp_path, [1, 2, UNLUCKY, 3, 4])
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


def test_changed_code_is_named_with_actor_step_and_output(tmp_path: Path) -> None:
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


def test_a_state_that_cannot_be_taken_up_any_more_is_a_difference(tmp_path: Path) -> None:
    class Changed(Tally):
        def restore(self, state: State) -> None:
            self._sum = state["total"]

    recorded(tmp_path, [1, 2, 3, UNLUCKY])
    with pytest.raises(ReplayDiverged, match=r"start before step 4 .*rejected, KeyError"):
        replayed(tmp_path, Changed).verify()


def test_an_output_more_or_less_is_a_difference(tmp_path: Path) -> None:
    class Talkative(Tally):
        def on_stop(self) -> Iterator[Message]:
            yield from super().on_stop()
            yield Double(stamp_ns=0, value=0)

    recorded(tmp_path, [1])
    with pytest.raises(ReplayDiverged, match="1 outputs, now 2"):
        replayed(tmp_path, Talkative).verify()


def test_a_step_that_fails_only_now_is_a_difference(tmp_path: Path) -> None:
    class Fragile(Tally):
        def handle(self, message: Message) -> Iterator[Message]:
            raise KeyError("new")
            yield from super().handle(message)

    recorded(tmp_path, [1])
    with pytest.raises(ReplayDiverged, match=r"step 0 .* a failure, KeyError"):
        replayed(tmp_path, Fragile).verify()


def test_a_hidden_input_is_found(tmp_path: Path) -> None:
    """An actor that looks at something outside its messages, here at how many there have been."""
    recorded(tmp_path, VALUES, make=lambda: Tally(bias=0))
    with pytest.raises(ReplayDiverged, match="step 0"):
        replayed(tmp_path, lambda: Tally(bias=1)).verify()


def test_a_flipped_bit_in_a_message_is_found(tmp_path: Path) -> None:
    path = recorded(tmp_path, VALUES)
    content = bytearray(path.read_bytes())
    nine = content.index(b"\xa5value\x09") + 6  # message 5
    content[nine] ^= 1
    path.write_bytes(content)
    with pytest.raises(ReplayDiverged, match=r"step 5 .*checksum of its input"):
        replayed(tmp_path).verify()


def test_an_actor_that_talks_to_the_outside_is_left_out(tmp_path: Path) -> None:
    class Asking(Tally):
        talks_outside = True

        def handle(self, message: Message) -> Iterator[Message]:
            pytest.fail(f"asked about {message}")
            yield message

    recorded(tmp_path, VALUES)
    result = replayed(tmp_path, Asking)
    result.verify()
    assert result.made == {}


# --- what was not recorded ------------------------------------------------------------------------
def test_a_replay_ends_at_a_gap_and_does_not_pass(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    recorded(tmp_path, range(20, 60), config=tiny, meanwhile=BusyDisk(25, 50))
    result = replayed(tmp_path)
    assert result.difference is None
    assert 5 <= result.steps < 20
    with pytest.raises(DataError, match=r"has a gap before step \d+: the disk was too slow"):
        result.verify()


def test_after_a_gap_a_restart_is_replayed_again(tmp_path: Path) -> None:
    tiny = RecordConfig(queue_mb=0.012)
    values = [*range(20, 60), UNLUCKY, 60, 61]
    recorded(tmp_path, values, config=tiny, meanwhile=BusyDisk(25, 50))
    result = replayed(tmp_path)
    assert result.difference is None
    assert (result.starts, result.failures, result.dead_lettered) == (3, 1, 1)
    assert not result.is_complete


def test_a_recording_that_ended_at_its_limit_replays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "CHECK_EVERY_BYTES", 100)
    recorded(tmp_path, range(20, 60), config=RecordConfig(max_gb=6e-6))
    result = replayed(tmp_path)
    result.verify()
    assert 0 < result.steps < 40
    assert result.notes == [f"tally.mcap ends at its size limit, before step {result.steps}."]


def test_a_missing_message_is_bad_data(tmp_path: Path) -> None:
    path = recorded(tmp_path, VALUES)
    rewrite(path, CompressionType.NONE, leave_out=(NUMBERS.name, 3))
    with pytest.raises(DataError, match="message of step 3 is missing"):
        replayed(tmp_path)


# --- files ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("compression", list(CompressionType)[::2], ids=lambda c: c.name)
def test_a_copy_by_another_program_replays(tmp_path: Path, compression: CompressionType) -> None:
    """In chunks, compressed or not, as the MCAP library and its tools write by default."""
    path = recorded(tmp_path, [*VALUES, UNLUCKY, 3])
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
def test_damage_anywhere_is_bad_data_or_a_difference(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = recorded(tmp_path, [1, 2, 3, UNLUCKY, 4])
    rewrite(path, compression)
    whole, rng, found = path.read_bytes(), random.Random(2), 0
    for place in rng.sample(range(len(whole)), 300):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            replayed(tmp_path).verify()
        except (DataError, ReplayDiverged):
            found += 1
    assert found > 20


@pytest.mark.parametrize("content", [b"", b"not a recording at all", b"\x89MCAP0\r\n\x05\x01"])
def test_something_else_is_bad_data(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "tally.mcap").write_bytes(content)
    if content.startswith(b"\x89"):
        assert replayed(tmp_path).steps == 0
    else:
        with pytest.raises(DataError, match="cannot be read as a recording"):
            files(tmp_path)
