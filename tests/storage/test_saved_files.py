"""Tests of the files of a saved state while its actor does not run."""

from pathlib import Path

import pytest

from ldo_service.errors import DamagedStateError
from ldo_service.storage import saved_files
from ldo_service.storage.checksummed_folder import ChecksummedFolder
from ldo_service.storage.message_log import LoggedMessage, MessageLog
from ldo_service.storage.saved_files import SavedFiles
from ldo_service.storage.state_store import FolderStore


def test_file_that_an_actor_removes_after_the_start_does_not_damage_its_state(
    tmp_path: Path,
) -> None:
    """A process that is killed before it saves again leaves a list with the removed file."""
    images = ChecksummedFolder(tmp_path / "images", suffix="image", consequence="")
    images.write(1, b"an image")
    store = FolderStore(tmp_path / "state")
    store.save("mapper", {"map": [1]}, images.unsynced_files())
    SavedFiles(store, "mapper").check_unsynced()
    SavedFiles(store, "mapper").sync_unsynced()  # A starting service does this.
    for path in images.unsynced_files():
        path.unlink()
    again = FolderStore(tmp_path / "state")
    SavedFiles(again, "mapper").check_unsynced()
    assert again.load("mapper") == {"map": [1]}


def test_file_that_a_power_cut_damaged_damages_the_state(tmp_path: Path) -> None:
    images = ChecksummedFolder(tmp_path / "images", suffix="image", consequence="")
    images.write(1, b"an image")
    store = FolderStore(tmp_path / "state")
    store.save("mapper", {"map": [1]}, images.unsynced_files())
    for path in images.unsynced_files():
        path.write_bytes(b"")
    with pytest.raises(DamagedStateError, match="damaged"):
        SavedFiles(store, "mapper").check_unsynced()


def test_state_is_synced_with_its_images_and_its_backlog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = ChecksummedFolder(tmp_path / "images", suffix="image", consequence="")
    images.write(1, b"an image")
    store = FolderStore(tmp_path / "state")
    store.save("mapper", {"map": [1], "now": [2]}, images.unsynced_files())
    folder = store.backlog_folder("mapper") / "keyframe.new"
    MessageLog(folder, 1, 0, 0, max_bytes=1000).append([LoggedMessage(0, b"", b"body")])
    synced: list[Path] = []
    monkeypatch.setattr(saved_files, "sync_all", synced.extend)
    SavedFiles(store, "mapper").sync()
    SavedFiles(store, "tracker").sync()  # It has no state.
    files = {path for path in tmp_path.rglob("*") if path.is_file()}
    assert set(synced) == files | {path.parent for path in files}
