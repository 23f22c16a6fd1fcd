"""Tests of the older generations of the states of several actors."""

from pathlib import Path

import pytest

from ldo_service.errors import DamagedStateError
from ldo_service.runtime.generations import (
    MARKER,
    complete_generation,
    completed_generation,
    keep_stopped,
    next_generation,
    problem_of_states,
)
from ldo_service.runtime.outbox import MAX_RETAINED_BYTES, Outbox
from ldo_service.runtime.outlets import OutletOpener
from ldo_service.runtime.supervision_policy import SupervisionConfig
from ldo_service.storage import message_log
from ldo_service.storage.message_log import MessageLog
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.flow_control import OutletPosition, UnackedMessage
from ldo_service.transport.interface import MemoryTransport

from .fake_actors import NUMBERS

ACTORS = ("tracker", "mapper", "optimizer")
TOPIC = "keyframe/new"


def save_producer(store: FolderStore, seq: int, unhandled: tuple[int, ...] = ()) -> None:
    sent = {f"stage.outbox keyframe.new {n}": UnackedMessage(n, b"", b"") for n in unhandled}
    offsets = {"in": {}, "out": {TOPIC: (1, seq, None)}}
    store.save("tracker", {"now": [seq], "stage.offsets": offsets, **sent})


def save_consumer(store: FolderStore, actor: str, handled: int, epoch: int = 1) -> None:
    offsets = {"in": {TOPIC: (epoch, handled)}, "out": {}}
    store.save(actor, {"map": [handled], "stage.offsets": offsets})


@pytest.fixture
def store(tmp_path: Path) -> FolderStore:
    """A store of a producer with eight messages, of which two are unhandled."""
    store = FolderStore(tmp_path / "state")
    save_producer(store, 8, (6, 7))
    save_consumer(store, "mapper", 6)
    save_consumer(store, "optimizer", 8)
    return store


# --- states that belong together ------------------------------------------------------------------
def test_states_with_all_unhandled_messages_belong_together(store: FolderStore) -> None:
    for is_quick in (False, True):
        assert problem_of_states(store, ACTORS, is_quick=is_quick) is None


@pytest.mark.parametrize(
    ("handled", "epoch", "text"),
    [
        (9, 1, "mapper is newer than tracker"),
        (5, 1, "mapper lacks messages that tracker no longer has"),
        (0, 0, "mapper lacks messages that tracker no longer has"),
        (7, 2, "mapper has messages of another run"),
    ],
)
def test_states_that_do_not_fit_are_described(
    store: FolderStore, handled: int, epoch: int, text: str
) -> None:
    save_consumer(store, "mapper", handled, epoch)
    for is_quick in (False, True):
        assert text in str(problem_of_states(store, ACTORS, is_quick=is_quick))


def test_missing_state_that_an_older_generation_has_is_a_problem(store: FolderStore) -> None:
    save_consumer(store, "loop_closer", 8)
    assert problem_of_states(store, (*ACTORS, "loop_closer")) is None
    store.save("frame_source", {"last_stamp_ns": 1})  # It has no lossless links.
    everyone = (*ACTORS, "loop_closer", "frame_source")
    keep_stopped(store, everyone, 1)
    for is_quick in (False, True):
        assert problem_of_states(store, everyone, is_quick=is_quick) is None
    (store.folder / "loop_closer" / "contents.msgpack").unlink()
    assert "no state of loop_closer" in str(problem_of_states(store, everyone))


# --- number of the generation ---------------------------------------------------------------------
def test_number_of_a_generation_is_never_used_again(store: FolderStore) -> None:
    assert completed_generation(store) is None
    keep_stopped(store, ACTORS, next_generation(store))
    assert completed_generation(store) == 1
    store.keep("mapper", next_generation(store), 1).write()  # Generation 2 is never complete.
    assert next_generation(store) == 3
    complete_generation(store, 5)
    assert next_generation(store) == 6
    (store.folder / MARKER).write_bytes(b"")
    with pytest.raises(DamagedStateError):
        completed_generation(store)
    assert next_generation(store) == 3


# --- messages for the consumers of the next generation --------------------------------------------
def outbox_of(count: int, size: int = 1) -> Outbox:
    return Outbox(UnackedMessage(n, b"", bytes(size)) for n in range(count))


def test_messages_handled_since_the_generation_before_are_retained() -> None:
    outbox = outbox_of(30)
    outbox.keep(3, is_previous_complete=False)
    outbox.forget(7)
    assert outbox.in_memory[0].seq == 3
    outbox.keep(10, is_previous_complete=True)
    outbox.forget(12)
    assert outbox.in_memory[0].seq == 3, "consumers of this generation may be at 3"
    for handled in (15, 20):
        outbox.keep(handled, is_previous_complete=True)
    outbox.forget(25)
    assert outbox.in_memory[0].seq == 10
    assert outbox.first_needed(25) == 10


def test_generation_that_is_not_complete_releases_no_messages() -> None:
    outbox = outbox_of(30)
    for handled in (3, 10, 15, 20):
        outbox.keep(handled, is_previous_complete=False)
    outbox.forget(25)
    assert outbox.in_memory[0].seq == 3


def test_generations_that_are_never_complete_take_no_memory() -> None:
    outbox = outbox_of(3000)
    for handled in range(1000, 2000):
        outbox.keep(handled, is_previous_complete=False)
    assert len(outbox._handled_at_keeps) == 4
    outbox.keep(2000, is_previous_complete=True)
    outbox.forget(2500)
    assert outbox.in_memory[0].seq == 1998


def test_retained_messages_do_not_exceed_their_maximum_size() -> None:
    outbox = outbox_of(11, size=MAX_RETAINED_BYTES // 10)
    outbox.keep(0, is_previous_complete=False)
    outbox.forget(9)
    assert outbox.in_memory[0].seq == 9


def test_message_after_a_time_without_consumers_is_found() -> None:
    outbox = outbox_of(5)
    outbox.keep(2, is_previous_complete=False)
    outbox.forget(5)  # The only consumer has left; the outlet adds no messages without consumers.
    outbox.add(UnackedMessage(20, b"", b"new"))
    assert outbox.read(20) == UnackedMessage(20, b"", b"new")
    assert outbox.read(7) is None


def test_logged_messages_of_any_size_are_retained_on_disk_only(tmp_path: Path) -> None:
    log = MessageLog(tmp_path, 1, 0, 0, max_bytes=10 * MAX_RETAINED_BYTES)
    outbox = Outbox(log=log, retained_from=0)
    body = bytes(MAX_RETAINED_BYTES // 7)
    for seq in range(9):
        outbox.add(UnackedMessage(seq, b"", body))
    outbox.store()
    outbox.forget(9)
    assert outbox.first_needed(9) == outbox.first(9) == 0
    assert outbox.read(0) == UnackedMessage(0, b"", body)
    assert len(outbox._memory) == 0


def test_retained_messages_that_exceed_the_log_do_not_count_as_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 100)
    outbox = Outbox(log=MessageLog(tmp_path, 1, 0, 0, max_bytes=1000), retained_from=0)
    for seq in range(30):
        outbox.add(UnackedMessage(seq, b"", bytes(100)))
        outbox.store()
        outbox.forget(seq)
    assert outbox.first(30) > 10
    assert outbox.dropped == 0
    for seq in range(30, 60):  # The consumer has stopped.
        outbox.add(UnackedMessage(seq, b"", bytes(100)))
        outbox.store()
    assert outbox.dropped == outbox.first(60) - 29


def test_message_handled_before_the_first_generation_is_retained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A consumer whose kept state is older than the message needs it again in that generation."""
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 100)
    monkeypatch.setattr("ldo_service.runtime.outbox.MAX_RETAINED_BYTES", 1000)
    logged = {NUMBERS.name: frozenset({"slow"})}
    opener = OutletOpener(
        MemoryTransport(), SupervisionConfig(), FolderStore(tmp_path), logged, logged, print
    )
    outbox = opener._outbox("source", NUMBERS, OutletPosition(1, 0), is_logged=True)
    for seq in range(30):
        outbox.add(UnackedMessage(seq, b"", bytes(100)))
        outbox.store()
        outbox.forget(seq + 1)
        if seq == 3:
            assert outbox.first_needed(4) == outbox.first(4) == 0
    assert outbox.first(30) > 10, "without generations, the disk holds 1000 bytes of them"


def test_backlog_of_a_temporary_state_retains_no_handled_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_log, "SEGMENT_BYTES", 100)
    logged = {NUMBERS.name: frozenset({"slow"})}
    store = FolderStore(tmp_path, has_generations=False)
    opener = OutletOpener(MemoryTransport(), SupervisionConfig(), store, logged, logged, print)
    outbox = opener._outbox("source", NUMBERS, OutletPosition(1, 0), is_logged=True)
    for seq in range(30):
        outbox.add(UnackedMessage(seq, b"", bytes(100)))
        outbox.store()
        outbox.forget(seq + 1)
    assert outbox.size_bytes == 0, "no generation is ever kept"


def test_outbox_without_generations_retains_nothing() -> None:
    outbox = outbox_of(5)
    outbox.forget(4)
    assert [message.seq for message in outbox.in_memory] == [4]
    assert outbox.first_needed(4) == 4
