"""Tests of atomic writes: a reader sees the old or the new content, and failures leave no files."""

from pathlib import Path

import pytest

from ldo_service.storage.atomic_write import folder_made_atomically, write_atomically


@pytest.mark.parametrize("unique", [False, True])
def test_file_is_replaced_by_all_parts(tmp_path: Path, unique: bool) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    assert write_atomically(path, b"new", b" content", unique=unique) == 11
    assert path.read_bytes() == b"new content"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("unique", [False, True])
def test_failed_write_keeps_the_old_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unique: bool
) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def fail(*_: Path) -> None:
        raise OSError("no rename")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="no rename"):
        write_atomically(path, b"new", unique=unique)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_appears_when_its_block_ends(tmp_path: Path) -> None:
    with folder_made_atomically(tmp_path / "made") as folder:
        folder.mkdir()
        (folder / "file").write_text("content")
        assert not (tmp_path / "made").exists()
    assert (tmp_path / "made/file").read_text() == "content"
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_folder_does_not_appear_when_its_block_fails(tmp_path: Path) -> None:
    def make() -> None:
        with folder_made_atomically(tmp_path / "made") as folder:
            folder.mkdir()
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        make()
    assert list(tmp_path.iterdir()) == []
