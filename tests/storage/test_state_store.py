import errno
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ldo_service.errors import DamagedStateError, DataError
from ldo_service.storage import atomic_write, state_codec, state_store
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import FolderStore

FULL_STATE: dict[str, Any] = {
    "counters": {"frames": 3, "names": ["a", "b"], "nothing": None},
    "means": np.arange(6, dtype=np.float32).reshape(2, 3),
    "mask": np.array([True, False]),
    "random": np.array([2**64 - 1], np.uint64),
    "empty": np.zeros((0, 3)),
    "scalar": np.float32(1.5),
    "bytes": b"\0\1",
    "nothing": None,
}


def assert_same(one: Any, other: Any) -> None:
    assert one.keys() == other.keys()
    for part in one:
        if isinstance(one[part], np.ndarray):
            assert one[part].dtype == other[part].dtype
        np.testing.assert_array_equal(one[part], other[part])


@pytest.fixture(params=["memory", "folder"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> MemoryStore | FolderStore:
    return MemoryStore() if request.param == "memory" else FolderStore(tmp_path)


def test_loaded_state_equals_the_saved_one(store: MemoryStore | FolderStore) -> None:
    assert store.load("mapper") is None
    store.save("mapper", FULL_STATE)
    loaded = store.load("mapper")
    assert loaded is not None
    assert_same(loaded, FULL_STATE)
    assert store.load("tracker") is None


def test_empty_state_writes_no_files(store: MemoryStore | FolderStore, tmp_path: Path) -> None:
    store.save("mapper", {})
    assert store.load("mapper") is None
    assert list(tmp_path.iterdir()) == []


def test_loaded_arrays_are_writable(tmp_path: Path) -> None:
    FolderStore(tmp_path).save("mapper", FULL_STATE)
    state = FolderStore(tmp_path).load("mapper")
    assert state is not None
    state["means"][0, 0] = 9


def test_unchanged_part_is_not_rewritten(tmp_path: Path) -> None:
    store, big = FolderStore(tmp_path), np.zeros(10)
    store.save("mapper", {"big": big, "step": 1000})
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "mapper").glob("big*")}
    store.save("mapper", {"big": big, "step": 1001})
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "mapper").glob("big*")}
    assert before == after
    assert FolderStore(tmp_path).load("mapper") == {"big": pytest.approx(big), "step": 1001}


def test_interrupted_save_leaves_the_complete_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", {"one": [1], "two": [1]})
    store.save("mapper", {"one": [2], "two": [2]})

    for failing_file in ("one", "two", "contents"):
        monkeypatch.undo()
        interrupt_write(monkeypatch, failing_file)
        with pytest.raises(OSError, match="disk full"):
            store.save("mapper", {"one": [3], "two": [3]})
        assert FolderStore(tmp_path).load("mapper") == {"one": [2], "two": [2]}
    monkeypatch.undo()
    store.save("mapper", {"one": [4], "two": [4]})
    assert FolderStore(tmp_path).load("mapper") == {"one": [4], "two": [4]}


def interrupt_write(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Make writing of files whose name starts with `name` fail halfway."""
    write = Path.write_bytes

    def write_half(path: Path, data: bytes) -> int:
        if path.name.startswith(name):
            write(path, data[: len(data) // 2])
            raise OSError("disk full")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", write_half)


def test_files_listed_before_a_failed_sync_are_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The call of `interrupt_write` simulates a kill during the next save."""
    store, folder, same = FolderStore(tmp_path, syncs=True), tmp_path / "mapper", [0]
    store.save("mapper", {"same": same, "step": [1], "old": [1]})
    sync = atomic_write.sync

    def fail(path: Path) -> None:
        if path == folder:
            raise OSError("fsync failed")
        sync(path)

    monkeypatch.setattr(atomic_write, "sync", fail)
    with pytest.raises(OSError, match="fsync failed"):
        store.save("mapper", {"same": same, "step": [2]})
    monkeypatch.undo()
    interrupt_write(monkeypatch, "step")
    with pytest.raises(OSError, match="disk full"):
        store.save("mapper", {"same": same, "step": [3]})
    assert FolderStore(tmp_path).load("mapper") == {"same": [0], "step": [2]}
    monkeypatch.undo()
    store.save("mapper", {"same": same, "step": [4]})
    assert FolderStore(tmp_path).load("mapper") == {"same": [0], "step": [4]}
    assert len(list(folder.iterdir())) == 3, "files of the old state are removed"


@pytest.mark.parametrize("call", ["replace", "unlink"])
def test_disk_call_that_reports_a_failure_but_succeeded_is_detected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    """This happens on network file systems when the reply is lost and not the request."""
    store, same = FolderStore(tmp_path), [0]
    store.save("mapper", {"same": same, "step": [1], "old": [1]})
    call_disk = getattr(os, call)

    def call_disk_and_fail(*arguments: object, **options: object) -> None:
        call_disk(*arguments, **options)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, call, call_disk_and_fail)
    with suppress(OSError):
        store.save("mapper", {"same": same, "step": [2]})
    monkeypatch.undo()
    interrupt_write(monkeypatch, "step")
    with pytest.raises(OSError, match="disk full"):
        store.save("mapper", {"same": same, "step": [3]})
    assert FolderStore(tmp_path).load("mapper") == {"same": [0], "step": [2]}


def test_file_that_cannot_be_removed_does_not_stop_a_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    FolderStore(tmp_path).save("mapper", {"step": [0]})
    (tmp_path / "mapper" / "left.a").write_bytes(b"")
    monkeypatch.setattr(os, "unlink", refuse)
    store = FolderStore(tmp_path)
    for step in (1, 2):
        store.save("mapper", {"step": [step]})
    assert FolderStore(tmp_path).load("mapper") == {"step": [2]}


def test_state_is_rewritten_completely_after_a_failed_delete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, same = FolderStore(tmp_path), [0]
    store.save("mapper", {"same": same})

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "unlink", refuse)
    with suppress(OSError):
        store.delete("mapper")
    monkeypatch.undo()
    store.save("mapper", {"same": same, "step": [1]})
    assert FolderStore(tmp_path).load("mapper") == {"same": [0], "step": [1]}
    store.delete("mapper")
    assert FolderStore(tmp_path).load("mapper") is None
    store.save("mapper", {"same": same})
    assert FolderStore(tmp_path).load("mapper") == {"same": [0]}


def test_read_error_raises_and_leaves_the_state_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    FolderStore(tmp_path).save("mapper", {"step": [1]})

    def fail(_: Path) -> bytes:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(Path, "read_bytes", fail)
    with pytest.raises(DataError, match=r"Too many open files\. The state is unchanged"):
        FolderStore(tmp_path).load("mapper")
    monkeypatch.undo()
    assert FolderStore(tmp_path).load("mapper") == {"step": [1]}


def test_removed_part_is_deleted_from_the_folder(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", {"one": [1], "two": [1]})
    store.save("mapper", {"one": [1]})
    assert FolderStore(tmp_path).load("mapper") == {"one": [1]}
    assert not list((tmp_path / "mapper").glob("two*"))


def test_many_saves_leave_at_most_two_files_per_part(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    for step in range(50):
        store.save("mapper", {"step": [step]})
    assert len(list((tmp_path / "mapper").iterdir())) <= 3
    assert FolderStore(tmp_path).load("mapper") == {"step": [49]}


@pytest.mark.parametrize("file", ["step.1", state_store.CONTENTS])
@pytest.mark.parametrize("noise", [b"", b"\xc1noise", b"\x93", b"\xc7\x01\x07\x00"])
def test_damaged_file_is_an_error_and_unchanged(tmp_path: Path, file: str, noise: bytes) -> None:
    FolderStore(tmp_path).save("mapper", {"step": [1]})
    (tmp_path / "mapper" / file).write_bytes(noise)
    store = FolderStore(tmp_path)
    with pytest.raises(DamagedStateError, match=file):
        store.load("mapper")
    assert (tmp_path / "mapper" / file).read_bytes() == noise
    store.save("mapper", {"step": [2]})
    assert FolderStore(tmp_path).load("mapper") == {"step": [2]}


def test_flipped_bits_of_a_state_are_detected(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", FULL_STATE)
    store.keep("mapper", 7, 0).write()
    of_generation = {path.name for path in (tmp_path / "mapper").iterdir()} - {
        state_store.CONTENTS, *(f"{part}.{n + 1}" for n, part in enumerate(FULL_STATE))
    }  # fmt: skip
    for path in sorted((tmp_path / "mapper").iterdir()):
        body = path.read_bytes()
        generation = 7 if path.name in of_generation else state_store.NEWEST
        for bit in range(0, 8 * len(body), 11):
            flipped = bytearray(body)
            flipped[bit // 8] ^= 1 << bit % 8
            path.write_bytes(flipped)
            with pytest.raises(DamagedStateError):
                FolderStore(tmp_path).load("mapper", generation)
        path.write_bytes(body)
    for generation in (7, state_store.NEWEST):
        loaded = FolderStore(tmp_path).load("mapper", generation)
        assert loaded is not None
        assert_same(loaded, FULL_STATE)


def test_missing_file_is_an_error(tmp_path: Path) -> None:
    FolderStore(tmp_path).save("mapper", {"step": [1]})
    (tmp_path / "mapper" / "step.1").unlink()
    with pytest.raises(DamagedStateError, match=r"step\.1"):
        FolderStore(tmp_path).load("mapper")


# --- older generations ----------------------------------------------------------------------------
def test_kept_generation_is_unchanged_by_later_saves(tmp_path: Path) -> None:
    store, same = FolderStore(tmp_path), [0]
    store.save("mapper", {"same": same, "step": [1]})
    store.keep("mapper", 1, 0).write()
    for step in (2, 3):
        store.save("mapper", {"same": same, "step": [step]})
    for reader in (store, FolderStore(tmp_path)):
        assert reader.load("mapper", 1) == {"same": [0], "step": [1]}
        assert reader.load("mapper") == {"same": [0], "step": [3]}
    store.fall_back("mapper", 1)
    assert not store.has_fallen_back("mapper")
    assert store.load("mapper") == {"same": [0], "step": [1]}
    assert store.has_fallen_back("mapper")
    store.save("mapper", {"same": same, "step": [4]})
    reader = FolderStore(tmp_path)
    assert reader.load("mapper") == {"same": [0], "step": [4]}
    assert not reader.has_fallen_back("mapper")


def test_only_the_newest_and_the_last_complete_generation_are_kept(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    for step in range(1, 30):
        store.save("mapper", {"step": [step]})
        store.keep("mapper", step, 5).write()
        generations = {5, step} if step >= 5 else {step}
        assert {n for n in range(1, 30) if store.load("mapper", n)} == generations
    # The lists of three states, their files, and the file that was copied last.
    assert len(list((tmp_path / "mapper").iterdir())) == 6
    FolderStore(tmp_path).save("mapper", {"step": [30]})
    assert FolderStore(tmp_path).load("mapper", 5) == {"step": [5]}


def test_generations_that_are_given_up_leave_only_the_state(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", {"map": [1], "now": [2]})
    store.keep("mapper", 1, 0).write()
    being_written = store.keep("mapper", 2, 1)
    store.give_up("mapper")
    with pytest.raises(OSError, match="not needed any more"):
        being_written.write()
    assert not store.is_kept("mapper")
    assert [store.load("mapper", generation) for generation in (1, 2)] == [None, None]
    store.save("mapper", {"map": [3], "now": [4]})
    assert FolderStore(tmp_path).load("mapper") == {"map": [3], "now": [4]}
    store.keep("mapper", 3, 1).write()
    assert FolderStore(tmp_path).load("mapper", 3) == {"map": [3], "now": [4]}
    FolderStore(tmp_path).save("mapper", {"map": [3], "now": [5]})  # It removes unlisted files.
    assert len(list((tmp_path / "mapper").iterdir())) == 6


def test_actor_without_state_keeps_nothing(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    store.keep("mapper", 1, 0).write()
    assert not store.is_kept("mapper")
    store.save("mapper", {"step": [1]})
    store.fall_back("mapper", 1)
    assert FolderStore(tmp_path).load("mapper") is None


def test_deleted_state_has_no_generations(tmp_path: Path) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", {"step": [1]})
    store.keep("mapper", 1, 0).write()
    store.delete("mapper")
    assert not store.is_kept("mapper")
    assert list((tmp_path / "mapper").iterdir()) == []


def test_state_of_version_3_loads_and_is_kept_with_checksums(tmp_path: Path) -> None:
    folder = tmp_path / "mapper"
    folder.mkdir()
    (folder / "step.a").write_bytes(state_codec.encode_state([1]))
    body = msgspec.msgpack.encode({"files": {"step": "step.a"}, "version": 3})
    (folder / state_store.CONTENTS).write_bytes(body)
    store = FolderStore(tmp_path)
    assert store.load("mapper") == {"step": [1]}
    store.keep("mapper", 1, 0).write()
    assert (folder / state_store.CONTENTS).read_bytes() == body
    (folder / "step.1").write_bytes(state_codec.encode_state([2]))
    with pytest.raises(DamagedStateError, match="checksum"):
        store.load("mapper", 1)


@pytest.mark.parametrize("value", [{1, object()}, np.array([object()])])
def test_value_that_is_not_plain_is_rejected(tmp_path: Path, value: Any) -> None:
    with pytest.raises((NotImplementedError, TypeError)):
        FolderStore(tmp_path).save("mapper", {"strange": value})


def test_files_are_synced_before_the_contents_list_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Old files are removed only after the new contents file is on the disk."""
    synced: list[tuple[str, list[str]]] = []
    folder, sync = tmp_path / "mapper", atomic_write.sync

    def record_sync(path: Path) -> None:
        sync(path)
        synced.append((path.name, sorted(file.name for file in folder.iterdir())))

    for module in (atomic_write, state_store):
        monkeypatch.setattr(module, "sync", record_sync)
    store, same = FolderStore(tmp_path, syncs=True), [0]
    store.save("mapper", {"same": same, "step": [1]})
    assert synced[0][0] == tmp_path.name, "the parent folder is synced first"
    synced.clear()
    store.save("mapper", {"same": same, "step": [2]})
    contents, new = state_store.CONTENTS, f"{state_store.CONTENTS}.new"
    assert [name for name, _ in synced] == ["step.3", "mapper", new, "mapper"]
    assert new in synced[2][1]
    assert synced[3][1] == [contents, "same.1", "step.2", "step.3"]
    assert FolderStore(tmp_path).load("mapper") == {"same": [0], "step": [2]}


@pytest.mark.parametrize(
    ("contents", "version"),
    [({"step": "step.a"}, 1), ({"files": {"step": "step.a"}, "version": 99}, 99)],
)
def test_state_of_another_version_is_rejected_and_unchanged(
    tmp_path: Path, contents: dict, version: int
) -> None:
    FolderStore(tmp_path).save("mapper", {"step": [1]})
    file = tmp_path / "mapper" / state_store.CONTENTS
    file.write_bytes(msgspec.msgpack.encode(contents))
    before = {path.name: path.read_bytes() for path in file.parent.iterdir()}
    for use in (lambda s: s.load("mapper"), lambda s: s.save("mapper", {"step": [2]})):
        with pytest.raises(DataError, match=f"version={version}, and this service reads 3 and 4"):
            use(FolderStore(tmp_path))
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before
