"""Tests of the state folders from which a service resumes."""

import errno
import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from ldo_service.actors.mapper import Mapper
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.errors import ConfigError, DamagedStateError, DataError, UnavailableError
from ldo_service.runtime.generations import MARKER
from ldo_service.service import state_folder as module
from ldo_service.service.state_folder import (
    FALL_BACK_MARKER,
    RESET_MARKER,
    claim_state,
    state_folder,
)
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS, GENERATION, FolderStore

ACTORS = {"tracker": Tracker, "mapper": Mapper, "optimizer": Optimizer}


def save_states(folder: Path, keyframes_made: int, *actors: str) -> Path:
    """Write the states of actors without input, and of a tracker that made keyframes."""
    for name in actors:
        out = {"keyframe/new": (1, keyframes_made, None)} if name == "tracker" else {}
        state = {**ACTORS[name]().snapshot(), "stage.offsets": {"in": {}, "out": out}}
        FolderStore(folder / "state").save(name, state)
    return folder


def claim(folder: Path) -> None:
    with ExitStack() as stack:
        claim_state(folder, stack)


# --- folders that cannot be used ------------------------------------------------------------------
def open_folder(folder: Path) -> None:
    with ExitStack() as stack:
        state_folder(folder, stack)


def test_file_in_place_of_the_folder_is_a_wrong_argument(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "state", tmp_path / ("x" * 300)):
        with pytest.raises(ConfigError, match="cannot be used for state") as raised:
            open_folder(folder)
        assert raised.value.exit_code == ConfigError.exit_code


def test_folder_that_cannot_be_written_may_be_available_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(UnavailableError, match="Permission denied"):
        open_folder(tmp_path)
    read_only = SimpleNamespace(f_flag=os.ST_RDONLY)
    monkeypatch.setattr(os, "statvfs", lambda _: read_only)
    with pytest.raises(UnavailableError, match="Read-only file system"):
        open_folder(tmp_path)


@pytest.mark.parametrize("name", ["lock", RESET_MARKER, MARKER])
def test_file_system_that_becomes_read_only_may_be_available_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The disk refuses to open the lock, to complete a reset, or to read the generation."""
    claim(save_states(tmp_path, 5, *ACTORS))
    (tmp_path / RESET_MARKER).touch()

    def refuse(function: Callable) -> Callable:
        def call(path: Path, *arguments: Any, **options: Any) -> Any:
            if path.name == name:
                raise OSError(errno.EROFS, os.strerror(errno.EROFS))
            return function(path, *arguments, **options)

        return call

    for method in ("open", "unlink", "read_bytes"):
        monkeypatch.setattr(Path, method, refuse(getattr(Path, method)))
    with pytest.raises(UnavailableError, match="Read-only file system"):
        claim(tmp_path)


def test_folder_of_a_running_service_may_be_available_later(tmp_path: Path) -> None:
    with ExitStack() as stack:
        claim_state(tmp_path, stack)
        with pytest.raises(UnavailableError, match="another service uses"):
            claim(tmp_path)


# --- states of several actors ---------------------------------------------------------------------
def test_state_without_keyframes_is_accepted(tmp_path: Path) -> None:
    claim(save_states(tmp_path, 0, *ACTORS))


def test_full_disk_is_logged_and_the_service_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save_states(tmp_path, 5, *ACTORS)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(Path, "write_bytes", fail)
        claim(tmp_path)
    assert "No space left on device" in caplog.text
    caplog.clear()
    claim(tmp_path)
    assert caplog.records == []


@pytest.mark.parametrize("actors", [(), ("optimizer",), ("tracker", "mapper")])
def test_state_of_a_service_killed_during_start_is_accepted(tmp_path: Path, actors: tuple) -> None:
    claim(save_states(tmp_path, 0, *actors))


@pytest.mark.parametrize("missing", ["mapper", "optimizer"])
def test_state_with_a_missing_actor_is_rejected(tmp_path: Path, missing: str) -> None:
    save_states(tmp_path, 5, *(name for name in ACTORS if name != missing))
    with pytest.raises(ConfigError, match=f"no state of {missing}, but"):
        claim(tmp_path)


def test_unreadable_state_is_rejected_and_unchanged(tmp_path: Path) -> None:
    save_states(tmp_path, 5, *ACTORS)
    contents = tmp_path / "state" / "mapper" / CONTENTS
    body = contents.read_bytes()
    contents.unlink()
    contents.mkdir()  # Reading a folder as a file fails for every user.
    with pytest.raises(DataError, match=r"the state of mapper in .* cannot be read"):
        claim(tmp_path)
    contents.rmdir()
    contents.write_bytes(body)
    claim(tmp_path)


def test_state_with_tracker_older_than_mapper_is_rejected(tmp_path: Path) -> None:
    """The mapper would mistake new keyframes for repeated old ones."""
    save_states(tmp_path, 5, *ACTORS)
    offsets = {"in": {"keyframe/new": (1, 6)}, "out": {}}
    state = {**Mapper().snapshot(), "stage.offsets": offsets}
    FolderStore(tmp_path / "state").save("mapper", state)
    with pytest.raises(ConfigError, match="mapper is newer than tracker"):
        claim(tmp_path)


def test_states_of_two_runs_are_rejected(tmp_path: Path) -> None:
    """The mapper of the first run would drop the keyframes of the second run as repeated."""
    save_states(tmp_path, 0, *ACTORS)
    offsets = {"in": {"keyframe/new": (7, 6)}, "out": {}}
    state = {**Mapper().snapshot(), "stage.offsets": offsets}
    FolderStore(tmp_path / "state").save("mapper", state)
    with pytest.raises(ConfigError, match="mapper has messages of another run on keyframe/new"):
        claim(tmp_path)


def test_interrupted_reset_is_completed_at_the_next_start(tmp_path: Path) -> None:
    save_states(tmp_path, 0, *ACTORS)
    offsets = {"in": {"keyframe/new": (7, 6)}, "out": {}}
    state = {**Mapper().snapshot(), "stage.offsets": offsets}
    FolderStore(tmp_path / "state").save("mapper", state)
    FolderStore(tmp_path / "state").save("loop_closer", {"places": [1]})
    (tmp_path / RESET_MARKER).touch()
    claim(tmp_path)
    store = FolderStore(tmp_path / "state")
    assert [store.load(actor) for actor in (*ACTORS, "loop_closer")] == [None] * 4
    assert not (tmp_path / RESET_MARKER).exists()


@pytest.mark.parametrize("marker", [None, RESET_MARKER, FALL_BACK_MARKER])
@pytest.mark.parametrize("name", [CONTENTS, GENERATION.format(1)])
def test_folder_of_another_version_is_refused_and_unchanged(
    tmp_path: Path, marker: str | None, name: str
) -> None:
    save_generation_and_newer_states(tmp_path)
    file = tmp_path / "state" / "mapper" / name
    contents = read_contents(file)
    assert contents is not None
    file.write_bytes(msgspec.structs.replace(contents, version=99).encode())
    if marker:
        (tmp_path / marker).touch()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(DataError, match="version=99, and this service reads 3 and 4"):
        claim(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_interrupted_reset_of_remote_actors_stays_marked(tmp_path: Path) -> None:
    save_states(tmp_path, 5, *ACTORS)
    (tmp_path / RESET_MARKER).touch()
    with ExitStack() as stack:
        claim_state(tmp_path, stack, ("optimizer",))
    assert (tmp_path / RESET_MARKER).exists(), "`Control` still has to reset the optimizer"


def steps_of(folder: Path) -> list[int]:
    """Return the step of each saved state."""
    store = FolderStore(folder / "state")
    return [(store.load(actor) or {})["step"][0] for actor in ACTORS]


def save_generation_and_newer_states(folder: Path) -> None:
    """Keep a generation of step 1, save step 2, and damage the state of the mapper."""
    for step in (1, 2):
        store = FolderStore(folder / "state")
        for actor in ACTORS:
            store.save(actor, {"step": [step]})
        if step == 1:
            claim(folder)
    file = store._contents["mapper"].files["step"]
    (store.folder / "mapper" / file).write_bytes(b"")


@pytest.mark.parametrize("is_folder_lost", [False, True])
def test_generation_without_the_state_of_an_actor_is_refused(
    tmp_path: Path, is_folder_lost: bool
) -> None:
    folder = tmp_path / "state" / "loop_closer"
    FolderStore(folder.parent).save(folder.name, {"places": [1]})
    save_generation_and_newer_states(tmp_path)
    if is_folder_lost:
        shutil.rmtree(folder)
    else:
        (folder / GENERATION.format(1)).unlink()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(DamagedStateError, match="its state of loop_closer is missing"):
        claim(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_damage_after_a_completed_reset_falls_back_to_the_empty_map(tmp_path: Path) -> None:
    save_generation_and_newer_states(tmp_path)
    (tmp_path / RESET_MARKER).touch()
    claim(tmp_path)
    save_states(tmp_path, 5, *ACTORS)
    for path in (tmp_path / "state" / "mapper").iterdir():
        path.write_bytes(b"")
    claim(tmp_path)
    store = FolderStore(tmp_path / "state")
    assert [store.load(actor) for actor in ACTORS] == [None] * 3


@pytest.mark.parametrize("finished", range(4))
def test_interrupted_fall_back_is_finished_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finished: int
) -> None:
    save_generation_and_newer_states(tmp_path)
    fall_back, done = FolderStore.fall_back, []

    def killed(store: FolderStore, actor: str, generation: int) -> None:
        if len(done) == finished:
            raise KeyboardInterrupt
        fall_back(store, actor, generation)
        done.append(actor)

    with monkeypatch.context() as context:
        context.setattr(FolderStore, "fall_back", killed)
        with pytest.raises(KeyboardInterrupt) if finished < len(ACTORS) else nullcontext():
            claim(tmp_path)
    claim(tmp_path)
    assert steps_of(tmp_path) == [1, 1, 1]
    assert not (tmp_path / FALL_BACK_MARKER).exists()


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.ENOSPC, "Free some"), (errno.EROFS, "Make the folder writable")]
)
def test_fall_back_that_the_disk_interrupts_is_finished_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, advice: str
) -> None:
    save_generation_and_newer_states(tmp_path)
    fall_back = FolderStore.fall_back

    def fail(store: FolderStore, actor: str, generation: int) -> None:
        if actor == "tracker":
            raise OSError(number, os.strerror(number))
        fall_back(store, actor, generation)

    with monkeypatch.context() as full:
        full.setattr(FolderStore, "fall_back", fail)
        with pytest.raises(UnavailableError, match=f"{advice}.*; the next start tries again"):
            claim(tmp_path)
    claim(tmp_path)
    assert steps_of(tmp_path) == [1, 1, 1]


def test_removal_of_the_reset_marker_is_on_the_disk_before_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut that brought the marker back would delete the new map."""
    (tmp_path / RESET_MARKER).touch()
    was_marked: list[bool] = []
    sync = module.sync

    def record(path: Path) -> None:
        sync(path)
        if path == tmp_path:
            was_marked.append((tmp_path / RESET_MARKER).exists())

    monkeypatch.setattr(module, "sync", record)
    claim(tmp_path)
    assert was_marked == [False]


def test_completed_reset_leaves_no_fall_back_to_finish(tmp_path: Path) -> None:
    save_generation_and_newer_states(tmp_path)
    for marker in (RESET_MARKER, FALL_BACK_MARKER):
        (tmp_path / marker).touch()
    claim(tmp_path)
    assert FolderStore(tmp_path / "state").load("tracker") is None
    assert not (tmp_path / FALL_BACK_MARKER).exists()
