"""Tests of the log of unhandled messages, also after a crash at any byte."""

import random
from pathlib import Path

import pytest

from ldo_service.storage import message_log
from ldo_service.storage.message_log import LoggedMessage, MessageLog

LARGE = 1_000_000_000


def message(seq: int, size: int = 100) -> LoggedMessage:
    return LoggedMessage(seq, b"header %d" % seq, random.Random(seq).randbytes(size))


def open_log(folder: Path, first: int, end: int, max_bytes: int = LARGE) -> MessageLog:
    return MessageLog(folder, 7, first, end, max_bytes=max_bytes)


@pytest.fixture(autouse=True)
def small_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 300)


def test_messages_are_read_back_in_another_process(tmp_path: Path) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(20))
    log = open_log(tmp_path, 0, 20)
    assert (log.first, log.next) == (0, 20)
    assert [log.read(seq) for seq in range(20)] == [message(seq) for seq in range(20)]
    assert log.read(20) is None


def test_messages_beyond_the_saved_position_are_discarded(tmp_path: Path) -> None:
    """The process was killed after it wrote them and before it saved its state."""
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(20))
    log = open_log(tmp_path, 3, 12)
    assert (log.first, log.next) == (3, 12)
    log.append([message(12, size=55)])
    assert log.read(12) == message(12, size=55)
    assert log.read(13) is None
    assert log.read(2) is None


@pytest.mark.parametrize("cut", range(1, 260, 13))
def test_log_cut_at_any_byte_keeps_the_whole_messages(tmp_path: Path, cut: int) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(2))
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - cut])
    log = open_log(tmp_path, 0, 2)
    assert log.next == (1 if cut <= len(whole) // 2 else 0)
    log.append(message(seq) for seq in range(5))
    assert [log.read(seq) for seq in range(5)] == [message(seq) for seq in range(5)]


def test_damaged_message_is_lost_and_the_others_are_read(tmp_path: Path) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(3))
    (path,) = tmp_path.iterdir()
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 1
    path.write_bytes(whole)
    log = open_log(tmp_path, 0, 3)
    assert [log.read(seq) for seq in range(3)] == [message(0), None, message(2)]


def test_handled_messages_free_their_disk_space(tmp_path: Path) -> None:
    log = open_log(tmp_path, 0, 0)
    log.append(message(seq) for seq in range(30))
    size = log.size_bytes
    log.forget(28)
    assert log.size_bytes < size / 5
    assert log.read(27) is None
    assert log.read(28) == message(28)
    assert log.dropped == 0
    log.forget(30)
    assert list(tmp_path.iterdir()) == []


def test_oldest_messages_are_dropped_and_counted_at_the_maximum_size(tmp_path: Path) -> None:
    log = open_log(tmp_path, 0, 0, max_bytes=1000)
    log.append(message(seq) for seq in range(30))
    assert log.size_bytes <= 1000 + 300
    assert log.dropped == log.first > 0
    assert log.read(log.first) == message(log.first)
    assert log.read(log.first - 1) is None


def test_files_of_another_epoch_are_deleted(tmp_path: Path) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(9))
    log = MessageLog(tmp_path, 8, 0, 0, max_bytes=LARGE)
    assert list(tmp_path.iterdir()) == []
    log.append([message(0)])
    log.restart(9)
    assert log.next == 0
    assert list(tmp_path.iterdir()) == []


def test_log_continues_after_messages_that_are_missing_on_disk(tmp_path: Path) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(9))
    for path in tmp_path.iterdir():
        path.unlink()
    log = open_log(tmp_path, 2, 9)
    log.append([message(9)])
    assert (log.first, log.next) == (9, 10)
    assert log.read(9) == message(9)


def test_log_keeps_older_messages_when_its_end_is_missing(tmp_path: Path) -> None:
    """A power cut may lose the newest files although the state refers to them."""
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(9))
    *_, newest = sorted(tmp_path.iterdir())
    newest.unlink()
    log = open_log(tmp_path, 0, 9)
    end = log.next
    assert 0 < end < 9
    for _ in range(2):  # The hole stays in the log of the next process.
        log.append([message(9)])
        assert [log.read(seq) for seq in range(end)] == [message(seq) for seq in range(end)]
        assert [log.read(seq) for seq in range(end, 9)] == [None] * (9 - end)
        assert log.read(9) == message(9)
        assert log.after(end, 10) == 9
        assert log.after(9, 10) == 10
        log = open_log(tmp_path, 0, 10)


@pytest.mark.parametrize("bit", [3, 70, 100, 120, 140, 1000])
def test_flipped_bit_in_a_log_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, bit: int
) -> None:
    open_log(tmp_path, 0, 0).append(message(seq) for seq in range(9))
    open_log(tmp_path, 0, 9)
    assert caplog.records == []
    for path in sorted(tmp_path.iterdir()):
        body = path.read_bytes()
        flipped = bytearray(body)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        log = open_log(tmp_path, 0, 9)
        for seq in range(9):
            log.read(seq)
        assert "lost" in caplog.text
        path.write_bytes(body)
        caplog.clear()


def test_segment_that_is_being_written_is_not_deleted(tmp_path: Path) -> None:
    log = open_log(tmp_path, 0, 0)
    log.append([message(0)])

    class Forgetting(MessageLog):
        def _write(self, segment, one: LoggedMessage) -> int:
            self.forget(1)  # A credit arrives while the disk is slow.
            return super()._write(segment, one)

    log.__class__ = Forgetting
    log.append([message(1)])
    assert log.read(1) == message(1)
    assert open_log(tmp_path, 1, 2).read(1) == message(1)


def test_failed_write_leaves_a_log_of_whole_messages(tmp_path: Path) -> None:
    log = open_log(tmp_path, 0, 0)
    log.append([message(0)])

    def fails() -> LoggedMessage:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        log.append(fails() if seq == 2 else message(seq) for seq in (1, 2, 3))
    log.append(message(seq) for seq in (1, 2, 3))
    assert [log.read(seq) for seq in range(4)] == [message(seq) for seq in range(4)]
