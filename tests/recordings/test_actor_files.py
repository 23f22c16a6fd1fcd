"""Tests of the recorded files of an actor: they are linked, counted, checked and never changed."""

import errno
import os
import re
from pathlib import Path
from typing import Any

import pytest

from ldo_service.errors import DataError
from ldo_service.recordings import actor_files
from ldo_service.recordings.actor_files import ActorFiles, FileArchive
from ldo_service.recordings.mcap_file import RecordConfig, recording_bytes
from ldo_service.recordings.recorder import Recorder
from ldo_service.recordings.recording import JournalFile
from ldo_service.recordings.replay import ReplayReport, replay
from ldo_service.runtime.journal import Entry, Gap, Started, checksum

from .journal_helpers import Tally

BODIES = {"images/00000001.keyframe": b"one", "images/00000002.keyframe": b"second"}
CHECKSUMS = {name: checksum(body) for name, body in BODIES.items()}
LIMITS = RecordConfig()


@pytest.fixture
def files(tmp_path: Path) -> ActorFiles:
    """Two files of an actor, beside others that do not belong to its state."""
    images = tmp_path / "map" / "images"
    images.mkdir(parents=True)
    for name, body in {
        **BODIES,
        "images/3.keyframe.new": b"",
        "images/notes.keyframe": b"",
    }.items():
        (tmp_path / "map" / name).write_bytes(body)
    return ActorFiles(tmp_path / "map", ("images/*.keyframe", "gaussians/*.gaussians"))


@pytest.fixture
def archive(tmp_path: Path) -> FileArchive:
    (tmp_path / "recording").mkdir()
    return FileArchive(tmp_path / "recording" / "tally.2.mcap")


def content(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def test_files_are_linked_under_their_checksum(files: ActorFiles, archive: FileArchive) -> None:
    assert archive.add(files, LIMITS) == CHECKSUMS
    assert archive.folder.name == "tally.files"
    assert {path.name for path in archive.folder.iterdir()} == {
        f"{name.replace('/', '.')}.{crc}" for name, crc in CHECKSUMS.items()
    }
    assert {path.stat().st_nlink for path in archive.folder.iterdir()} == {2}


def test_missing_folder_of_an_actor_has_no_files(tmp_path: Path, archive: FileArchive) -> None:
    assert archive.add(ActorFiles(tmp_path / "none", ("images/*.keyframe",)), LIMITS) == {}
    assert not archive.folder.exists()


def refuse_link(_source: Path, _target: Path) -> None:
    raise OSError(errno.EXDEV, "another disk")


def test_files_on_another_disk_are_copied(
    files: ActorFiles, archive: FileArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "link", refuse_link)
    assert archive.add(files, LIMITS) == CHECKSUMS
    assert sorted(content(archive.folder).values()) == sorted(BODIES.values())
    assert {path.stat().st_nlink for path in archive.folder.iterdir()} == {1}


@pytest.mark.parametrize("is_linked", [True, False])
def test_next_start_reads_and_stores_changed_files_only(
    files: ActorFiles, archive: FileArchive, monkeypatch: pytest.MonkeyPatch, is_linked: bool
) -> None:
    if not is_linked:
        monkeypatch.setattr(os, "link", refuse_link)
    archive.add(files, LIMITS)
    replacement = files.folder / "replacement"
    replacement.write_bytes(b"masked")
    replacement.replace(files.folder / "images" / "00000002.keyframe")
    read: list[Any] = []
    monkeypatch.setattr(actor_files, "checksum", lambda body: read.append(body) or checksum(body))
    expected = {**CHECKSUMS, "images/00000002.keyframe": checksum(b"masked")}
    assert archive.add(files, LIMITS) == expected
    assert read == [b"masked"]
    assert sorted(content(archive.folder).values()) == [b"masked", b"one", b"second"]


def test_recorded_files_count_in_the_size_limit(files: ActorFiles, archive: FileArchive) -> None:
    with pytest.raises(OSError, match=r"more than recording\.max_gb=5e-09"):
        archive.add(files, RecordConfig(max_gb=5e-9))
    assert not archive.folder.exists()
    archive.add(files, LIMITS)
    assert recording_bytes(archive.folder.parent) == sum(map(len, BODIES.values()))


def test_copies_leave_the_minimum_of_free_disk_space(
    files: ActorFiles, archive: FileArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "link", refuse_link)
    with pytest.raises(OSError, match=r"less than recording\.min_free_gb=1e\+06"):
        archive.add(files, RecordConfig(min_free_gb=1e6))


# --- replay ---------------------------------------------------------------------------------------
def test_restored_files_replace_the_content_of_a_folder(
    files: ActorFiles, archive: FileArchive, tmp_path: Path
) -> None:
    checksums = archive.add(files, LIMITS)
    target = tmp_path / "replay"
    (target / "images").mkdir(parents=True)
    (target / "images" / "00000009.keyframe").touch()
    archive.restore(checksums, target)
    assert content(target) == BODIES


def test_removed_or_replaced_restored_files_stay_recorded(
    files: ActorFiles, archive: FileArchive, tmp_path: Path
) -> None:
    checksums = archive.add(files, LIMITS)
    before = content(archive.folder)
    for _ in range(2):
        archive.restore(checksums, tmp_path / "replay")
        one, second = (tmp_path / "replay" / name for name in BODIES)
        one.unlink()
        (tmp_path / "new").write_bytes(b"new")
        (tmp_path / "new").replace(second)
        assert content(archive.folder) == before


def test_missing_and_changed_files_are_errors(
    files: ActorFiles, archive: FileArchive, tmp_path: Path
) -> None:
    checksums = archive.add(files, LIMITS)
    one, second = sorted(archive.folder.iterdir())
    second.unlink()
    with pytest.raises(DataError, match=f"{second.name} cannot be read: No such file"):
        archive.restore(checksums, tmp_path / "replay")
    one.unlink()
    one.write_bytes(b"0ne")
    with pytest.raises(DataError, match=f"{one.name} has changed: its checksum is"):
        archive.restore(checksums, tmp_path / "replay")


@pytest.mark.parametrize(
    ("name", "crc"),
    [
        ("../1.keyframe", "00000000"),
        ("/etc/1.keyframe", "00000000"),
        ("images/../1.keyframe", "00000000"),
        ("images/1.keyframe", "../../1"),
    ],
)
def test_path_out_of_the_folder_is_rejected(
    archive: FileArchive, tmp_path: Path, name: str, crc: str
) -> None:
    with pytest.raises(DataError, match=re.escape(repr(name))):
        archive.restore({name: crc}, tmp_path / "replay")


# --- recorder and replay session ------------------------------------------------------------------
def record_start(folder: Path, files: ActorFiles | None, config: RecordConfig = LIMITS) -> Path:
    """Record the start of an actor with a saved state, and return the file."""
    folder.mkdir(exist_ok=True)
    recorder = Recorder(folder / "tally.mcap", {}, config, files)
    recorder.record_files()
    recorder.record_start({"sum": 3})
    recorder.close().result(10)
    return folder / "tally.mcap"


def entries(path: Path) -> list[Entry]:
    return list(JournalFile(path).entries())


def test_start_with_a_state_lists_the_files(files: ActorFiles, tmp_path: Path) -> None:
    (start,) = entries(record_start(tmp_path / "recording", files))
    assert isinstance(start, Started)
    assert start.files == CHECKSUMS


def test_files_beyond_the_limit_leave_a_gap_and_one_error(
    files: ActorFiles, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = record_start(tmp_path / "recording", files, RecordConfig(max_gb=5e-9))
    assert entries(path) == [Gap(step=0, reason="state")]
    assert caplog.text.count("cannot be recorded: the new files have 9e-09 GB") == 1


def replayed(path: Path, folder: Path) -> tuple[ReplayReport, list[dict[str, bytes]]]:
    """Replay a file; return the report and the content of the folder at each new actor."""
    seen: list[dict[str, bytes]] = []

    def make(_about: object) -> Tally:
        seen.append(content(folder))
        return Tally()

    return replay("tally", [JournalFile(path)], make, folder=folder), seen


def test_replayed_actor_starts_with_the_recorded_files(files: ActorFiles, tmp_path: Path) -> None:
    path = record_start(tmp_path / "recording", files)
    report, seen = replayed(path, tmp_path / "replay")
    assert seen == [BODIES]
    assert report.notes == []


def test_saved_map_recorded_without_files_is_a_note(tmp_path: Path) -> None:
    """Earlier versions did not record them."""
    path = record_start(tmp_path / "recording", None)
    report, _ = replayed(path, tmp_path / "replay")
    assert "recorded it without the keyframe images" in report.notes[0]
