"""Tests of the checkpoints of a stage whose actor writes files of its own."""

from pathlib import Path

import pytest

from ldo_service.gaussians.retired_files import RetiredFiles
from ldo_service.runtime import Actor, checkpointer
from ldo_service.runtime.checkpointer import MAX_UNSYNCED_FILES, Checkpointer
from ldo_service.storage import saved_files
from ldo_service.storage.checksummed_folder import ChecksummedFolder
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS, FolderStore


class Files(ChecksummedFolder):
    """Files of an actor that retires its files as the mapper does."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "img", "The test fails.")
        self.retired = RetiredFiles(self)

    def saved(self) -> None:
        self.retired.saved()

    def kept(self, *, is_previous_complete: bool) -> None:
        self.retired.kept(is_previous_complete=is_previous_complete)

    def retired_bytes(self) -> int:
        return self.retired.size_bytes


class Writer(Actor):
    """An actor that writes a file in each step."""

    name = "writer"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.files = Files(folder)


def unsynced_of(state: Path) -> tuple[str, ...]:
    contents = read_contents(state / "writer" / CONTENTS)
    assert contents is not None
    return contents.unsynced


def test_files_of_an_actor_are_synced_before_the_state_that_refers_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[object] = []
    store = FolderStore(tmp_path / "state", syncs=True)
    save = store.save
    monkeypatch.setattr(checkpointer, "sync_all", calls.append)
    monkeypatch.setattr(store, "save", lambda *args: (calls.append("save"), save(*args)))
    actor = Writer(tmp_path / "map")
    actor.files.write(7, b"image")
    (file,) = actor.files.unsynced_files()
    Checkpointer(store).write(actor, {"keyframe": [7]})
    synced, then = calls
    assert then == "save"
    assert isinstance(synced, list)
    assert {file, file.parent} <= set(synced)
    assert unsynced_of(tmp_path / "state") == ()


def test_sizes_are_reported_while_files_of_a_generation_disappear(tmp_path: Path) -> None:
    store = FolderStore(tmp_path / "state")
    checkpoints = Checkpointer(store)
    actor = checkpoints.restore_actor(lambda: Writer(tmp_path / "map"))
    assert "state_mb" not in checkpoints.metrics(), "nothing is saved yet"
    checkpoints.write(actor, {"keyframe": [7]})
    folder = tmp_path / "state" / actor.name
    size_mb = checkpoints.metrics()["state_mb"]
    assert size_mb == sum(file.stat().st_size for file in folder.iterdir()) / 1e6 > 0
    (folder / "renamed").symlink_to(folder / "gone")  # Listed, but without a size.
    metrics = checkpoints.metrics()
    assert metrics["state_mb"] == size_mb
    assert metrics["disk_free_mb"] > 0


def test_unsynced_files_are_synced_and_forgotten_if_no_generation_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(checkpointer, "sync_all", synced.extend)
    actor = Writer(tmp_path / "map")
    saver = Checkpointer(FolderStore(tmp_path / "state"))
    longest = 0
    for number in range(2 * MAX_UNSYNCED_FILES + 2):
        actor.files.write(number, b"image")
        saver.write(actor, {"keyframe": [number]})
        longest = max(longest, len(unsynced_of(tmp_path / "state")))
    assert longest == MAX_UNSYNCED_FILES
    files = [path for path in synced if path.suffix == ".img"]
    assert len(files) == len(set(files)) == 2 * MAX_UNSYNCED_FILES + 2


def test_files_that_only_older_generations_need_are_bounded_while_none_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(checkpointer, "MAX_RETIRED_BYTES", 1000)
    actor, store = Writer(tmp_path / "map"), FolderStore(tmp_path / "state")
    saver = Checkpointer(store)
    largest = 0
    for number in range(60):  # Each step replaces a file of 100 bytes.
        actor.files.write(number, bytes(92))
        if number:
            actor.files.retired.add(number - 1)
        actor.files.retired.on_snapshot()
        saver.write(actor, {"keyframe": [number]})
        saver.notify(actor)
        files, _ = saver.keep(actor, number + 1, completed=1)
        assert files is not None
        files.write()
        largest = max(largest, sum(actor.files.sizes.values()))
        if number == 5:
            assert store.load("writer", 1) == {"keyframe": [0]}
            assert 0 in actor.files.sizes
    assert largest <= 1300
    assert store.load("writer", 1) is None
    assert store.load("writer") == {"keyframe": [59]}
    assert store.load("writer", 60) == {"keyframe": [59]}
    errors = [r for r in caplog.records if r.levelname == "ERROR"]
    assert 1 <= len(errors) <= 6
    names = {path.name for path in (tmp_path / "state" / "writer").iterdir()}
    assert len(names) < 12, "copies of the deleted generations are removed"


def test_generation_is_only_the_last_kept_one_if_one_was_kept(tmp_path: Path) -> None:
    saver = Checkpointer(FolderStore(tmp_path / "state"))
    assert not saver.is_last_kept(0)
    actor = Writer(tmp_path / "map")
    saver.write(actor, {"keyframe": [1]})
    saver.keep(actor, 3, completed=0)
    assert saver.is_last_kept(3)
    saver.forget("writer")
    assert not saver.is_last_kept(0), "no generation is complete, so none releases files"


@pytest.mark.parametrize("is_same_process", [True, False])
def test_restored_actor_has_synced_the_files_of_the_actor_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_same_process: bool
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(saved_files, "sync_all", synced.extend)
    saver = Checkpointer(FolderStore(tmp_path / "state"))
    actor = Writer(tmp_path / "map")
    actor.files.write(0, b"image")
    saver.write(actor, {"keyframe": [0]})
    assert synced == []
    if not is_same_process:
        saver = Checkpointer(FolderStore(tmp_path / "state"))
    restored = saver.restore_actor(lambda: Writer(tmp_path / "map"))
    assert actor.files.unsynced_files()[0] in synced
    assert unsynced_of(tmp_path / "state") == ()
    saver.write(restored, {"keyframe": [1]})
    assert unsynced_of(tmp_path / "state") == ()


def test_files_that_cannot_be_synced_do_not_prevent_a_restore(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    saver = Checkpointer(FolderStore(tmp_path / "state"))
    actor = Writer(tmp_path / "map")
    actor.files.write(0, b"image")
    saver.write(actor, {"keyframe": [0]})
    monkeypatch.setattr(saved_files, "sync_all", fail)
    saver.restore_actor(lambda: Writer(tmp_path / "map"))
    assert "the files of its state cannot be synced" in caplog.text


def test_generations_that_cannot_be_deleted_are_logged_once_and_keep_their_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(checkpointer, "MAX_RETIRED_BYTES", 50)
    actor, store = Writer(tmp_path / "map"), FolderStore(tmp_path / "state")
    saver = Checkpointer(store)
    actor.files.write(0, bytes(92))
    saver.write(actor, {"keyframe": [0]})
    saver.keep(actor, 1, completed=0)
    actor.files.retired.add(0)
    actor.files.retired.on_snapshot()
    monkeypatch.setattr(store, "give_up", fail)
    for _ in range(2):
        saver.notify(actor)
    (error,) = (r for r in caplog.records if r.levelname == "ERROR")
    assert "its older generations cannot be deleted" in error.getMessage()
    assert 0 in actor.files.sizes
