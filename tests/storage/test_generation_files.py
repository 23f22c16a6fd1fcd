"""Tests of generations that are given up, while they are written or on a bad disk."""

from pathlib import Path

import pytest

from ldo_service.storage import atomic_write, generation_files, state_store
from ldo_service.storage.atomic_write import UNFINISHED
from ldo_service.storage.state_store import FolderStore


@pytest.mark.parametrize("synced", range(1, 4))
def test_generation_that_is_given_up_while_it_is_written_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, synced: int
) -> None:
    store = FolderStore(tmp_path)
    store.save("mapper", {"map": [1], "now": [2]})
    being_written = store.keep("mapper", 1, 0)
    store.save("mapper", {"map": [3], "now": [4]})
    calls: list[Path] = []

    def sync(path: Path) -> None:
        calls.append(path)
        if len(calls) == synced:  # The third sync is that of the list.
            store.give_up("mapper")
            if path.suffix != UNFINISHED:
                path.write_bytes(b"")  # The file may be open meanwhile.

    for module in (generation_files, atomic_write):
        monkeypatch.setattr(module, "sync", sync)
    with pytest.raises(OSError, match="not needed any more"):
        being_written.write()
    names = {path.name for path in (tmp_path / "mapper").iterdir()}
    assert names == {state_store.CONTENTS, *store._contents["mapper"].files.values()}


def test_failed_sync_of_given_up_generations_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    store = FolderStore(tmp_path)
    store.save("mapper", {"map": [1]})
    store.keep("mapper", 1, 0).write()
    monkeypatch.setattr(state_store, "sync", fail)
    for _ in range(2):
        with pytest.raises(OSError, match="Input/output error"):
            store.give_up("mapper")
