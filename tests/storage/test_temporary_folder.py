import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from ldo_service.storage import temporary_folder as module
from ldo_service.storage.temporary_folder import PREFIX, temporary_folder

# Program that makes a temporary folder with a file, prints its path and waits.
MAKER = """
from ldo_service.storage.temporary_folder import temporary_folder
with temporary_folder() as folder:
    (folder / "file").write_text("content")
    print(folder, flush=True)
    input()
"""


@pytest.fixture(autouse=True)
def temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of all temporary files, also those of child processes."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def start_maker() -> tuple[subprocess.Popen[str], Path]:
    """Start a process that holds a temporary folder."""
    maker = subprocess.Popen(
        [sys.executable, "-c", MAKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert maker.stdout
    return maker, Path(maker.stdout.readline().strip())


def test_folder_of_a_killed_process_is_removed_and_that_of_a_running_one_stays() -> None:
    (killed, left), (running, used) = start_maker(), start_maker()
    killed.kill()
    killed.communicate()
    assert (left / "file").exists()
    with temporary_folder() as folder:
        assert not left.exists()
        assert (used / "file").exists()
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not folder.exists()
    running.communicate("\n")
    assert running.returncode == 0
    assert not used.exists()


def test_folder_of_another_machine_stays_although_its_lock_is_not_visible(
    temporary_files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MACHINE_ID", temporary_files / "machine_id")
    for number, (machine_id, is_kept) in enumerate([("0123-5678", True), ("4567-9abc", False)]):
        module.MACHINE_ID.write_text(machine_id)
        path, lock = module.make_temporary_folder()
        os.close(lock)  # The processes below do not see the lock.
        module.MACHINE_ID.write_text("4567-9abc")
        with temporary_folder():
            assert path.exists() == is_kept, number


@pytest.mark.usefixtures("temporary_files")
def test_nothing_is_removed_if_locks_have_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    path, lock = module.make_temporary_folder()
    os.close(lock)
    with monkeypatch.context() as patch:
        patch.setattr("fcntl.flock", lambda _descriptor, _operation: None)
        with temporary_folder():
            assert path.exists()
    with temporary_folder():
        assert not path.exists()


def test_two_folders_of_one_process_do_not_remove_each_other() -> None:
    with temporary_folder() as first:
        with temporary_folder() as second:
            assert first.exists()
            assert second.exists()
        assert first.exists()


def test_folders_of_others_and_targets_of_links_stay(temporary_files: Path) -> None:
    kept = [temporary_files / "ldo-batch", temporary_files / "data"]
    for folder in kept:
        folder.mkdir()
        (folder / "file").touch()
    (temporary_files / f"{PREFIX}link").symlink_to(kept[1])
    (temporary_files / f"{PREFIX}file").touch()
    with temporary_folder():
        assert all((folder / "file").exists() for folder in kept)


def test_folder_that_is_removed_before_it_is_locked_is_made_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Path] = []

    def open_after_removal(path: Path) -> int:
        made.append(path)
        descriptor = original(path)
        if len(made) == 1:
            path.rmdir()
        return descriptor

    original = module._open
    monkeypatch.setattr(module, "_open", open_after_removal)
    with temporary_folder() as folder:
        assert folder.exists()
        assert made[1:] == [folder]
