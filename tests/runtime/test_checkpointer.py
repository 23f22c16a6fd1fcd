"""Tests of the checkpoints of a stage whose actor writes files of its own."""

from pathlib import Path

import pytest

from ldo_service.runtime import Actor, checkpointer
from ldo_service.runtime.checkpointer import MAX_UNSYNCED_FILES, Checkpointer
from ldo_service.storage.checksummed_folder import ChecksummedFolder
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS, FolderStore


class Files(ChecksummedFolder):
    """Files of an actor, which never retires one."""

    def saved(self) -> None:
        pass

    def kept(self, *, is_previous_complete: bool) -> None:
        pass


class Writer(Actor):
    """An actor that writes a file in each step."""

    name = "writer"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.files = Files(folder, "img", "The test fails.")


def unsynced_of(state: Path) -> tuple[str, ...]:
    contents = read_contents(state / "writer" / CONTENTS)
    assert contents is not None
    return contents.unsynced


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
