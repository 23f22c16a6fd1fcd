"""Staging folders: the limit of all processes, and folders of ended processes."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ldo_service.batch import staging
from ldo_service.batch.staging import staging_folder
from ldo_service.errors import DataError

KILLED = """
import os, sys
from pathlib import Path
from ldo_service.batch.staging import staging_folder
with staging_folder(Path(sys.argv[1]), 60, 100) as folder:
    (folder / "source").write_text("x")
    os._exit(9)
"""


def test_process_waits_until_the_limit_has_space_for_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(staging, "WAIT_S", 0.01)
    is_admitted = threading.Event()

    def second() -> None:
        with staging_folder(tmp_path, 60, 100):
            is_admitted.set()

    with staging_folder(tmp_path, 60, 100), staging_folder(tmp_path, 40, 100):
        thread = threading.Thread(target=second)
        thread.start()
        assert not is_admitted.wait(0.2)
        with staging_folder(tmp_path, 0, 100) as local:  # A local recording needs no copy.
            assert local.is_dir()
    assert is_admitted.wait(10)
    thread.join()
    assert list(tmp_path.glob("job-*")) == []


def test_folder_of_a_killed_process_is_removed_by_the_next_one(tmp_path: Path) -> None:
    assert subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False).returncode == 9
    (left,) = tmp_path.glob("job-*")
    with staging_folder(tmp_path, 60, 100) as folder:
        assert list(tmp_path.glob("job-*")) == [folder] != [left]
        staging.remove_abandoned(tmp_path)
        assert folder.is_dir()
    staging.remove_abandoned(tmp_path / "absent")


def test_recording_beyond_the_limit_and_unwritable_folder_are_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(DataError, match=r"more than --max-staged-gb 1 allows"),
        staging_folder(tmp_path, 2 * 10**9, 10**9),
    ):
        pass
    (tmp_path / "file").touch()
    with (
        pytest.raises(DataError, match="cannot be written"),
        staging_folder(tmp_path / "file", 0, 1),
    ):
        pass
