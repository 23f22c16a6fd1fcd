"""Tests of damaged state folders: all damage is detected, and the service falls back."""

import asyncio
import logging
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from ldo_service.errors import DamagedStateError, DataError
from ldo_service.runtime.generations import (
    MARKER,
    completed_generation,
    keep_last,
    problem_of_states,
)
from ldo_service.service.state_folder import claim_state
from ldo_service.storage import saved_files
from ldo_service.storage.generation_files import GenerationFiles
from ldo_service.storage.state_contents import read_contents
from ldo_service.storage.state_store import CONTENTS, FolderStore

from .bit_flips import FRAMES, files_of, make_state, undetected_flips
from .small_service import ACTORS, open_service


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state folder of a service that was stopped; tests must not change it."""
    folder = tmp_path_factory.mktemp("state")
    asyncio.run(make_state(folder))
    return folder


@pytest.fixture
def state(made: Path, tmp_path: Path) -> Path:
    """A copy of the state folder, which tests may change."""
    return shutil.copytree(made, tmp_path / "copy")


def newest_file(folder: Path, actor: str, part: str) -> Path:
    """Return the file of a part of the newest state of an actor."""
    contents = read_contents(folder / "state" / actor / CONTENTS)
    assert contents is not None
    return folder / "state" / actor / contents.files[part]


def flip(path: Path) -> None:
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 0x40
    path.write_bytes(body)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def claim(folder: Path) -> None:
    with ExitStack() as stack:
        claim_state(folder, stack)


async def keyframes_after_start(folder: Path) -> tuple[float, float]:
    """Start a service, send it a frame, and return its keyframes and whether it fell back."""
    async with open_service(folder) as service:
        assert all(service.state_of(actor) == "ready" for actor in ACTORS)
        await service.send_frame(FRAMES + 1)
        await service.wait_until_quiet()
        after = service.metric("mapper", "keyframes")
        fell_back = service.metric("mapper", "fell_back")
        await service.stop()
    return after, fell_back


def test_flipped_bits_in_all_files_are_detected(state: Path) -> None:
    tried, missed = undetected_flips(state, 600, seed=1)
    assert missed == []
    assert set(tried) >= {"part of a state", "list of files", "gaussians", "keyframe", "backlog"}


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
@pytest.mark.parametrize(
    ("actor", "part"),
    [
        ("mapper", "map"),
        ("tracker", "now"),
        ("tracker", "calibration_maker"),
        ("optimizer", "graph"),
    ],
)
def test_damaged_newest_state_falls_back_to_the_older_generation(
    state: Path, caplog: pytest.LogCaptureFixture, actor: str, part: str, damage: Callable
) -> None:
    damage(newest_file(state, actor, part))
    claim(state)
    (error,) = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
    assert f"the state of {actor}" in error
    assert "fall back" in error
    caplog.clear()
    claim(state)
    assert caplog.records == []


def test_service_continues_from_the_older_generation(state: Path) -> None:
    flip(newest_file(state, "tracker", "now"))
    claim(state)
    assert asyncio.run(keyframes_after_start(state)) == (FRAMES, 1), "one keyframe is lost"


def test_state_of_a_clean_stop_is_whole_after_a_power_cut(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stopped service has synced the newest states, and an older generation equals them."""
    synced: list[Path] = []
    monkeypatch.setattr(saved_files, "sync_all", synced.extend)
    before = completed_generation(FolderStore(state / "state"))
    keep_last(FolderStore(state / "state"), ACTORS)
    for actor in ACTORS:
        contents = read_contents(state / "state" / actor / CONTENTS)
        assert contents is None or {
            state / "state" / actor / f for f in contents.files.values()
        } <= set(synced)
    assert completed_generation(FolderStore(state / "state")) != before
    flip(newest_file(state, "tracker", "now"))
    claim(state)
    assert asyncio.run(keyframes_after_start(state)) == (FRAMES + 1, 1), "no keyframe is lost"


@pytest.mark.parametrize("failing", ["write", "check"])
def test_last_generation_that_cannot_be_kept_leaves_the_older_one_whole(
    state: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    store = FolderStore(state / "state")
    before = completed_generation(store)
    if failing == "check":
        tracker = dict(store.load("tracker") or {})
        offsets = tracker["stage.offsets"]
        tracker["stage.offsets"] = {**offsets, "out": {"keyframe/new": (1, 0, None)}}
        store.save("tracker", tracker)
    else:

        def fail(files: GenerationFiles) -> None:
            if files.folder.name == "tracker":
                raise OSError(28, "No space left on device")
            write(files)

        write = GenerationFiles.write
        monkeypatch.setattr(GenerationFiles, "write", fail)
    with pytest.raises((OSError, DataError)):
        keep_last(store, ACTORS)
    assert completed_generation(store) == before
    assert before is not None
    assert problem_of_states(FolderStore(state / "state"), ACTORS, before) is None


def test_undamaged_state_does_not_fall_back(state: Path) -> None:
    claim(state)
    assert asyncio.run(keyframes_after_start(state)) == (FRAMES + 1, 0)


def test_state_without_an_undamaged_generation_is_one_error_and_unchanged(state: Path) -> None:
    for path in (state / "state" / "tracker").glob("now.*"):
        flip(path)
    before = {path: path.read_bytes() for path in files_of(state)}
    for _ in range(2):
        with pytest.raises(DamagedStateError, match="generation 2, is not usable either"):
            claim(state)
    assert DamagedStateError.exit_code == 3, "the unit starts the service again"
    assert {path: path.read_bytes() for path in files_of(state)} == before


def test_missing_state_of_one_actor_falls_back(state: Path) -> None:
    (state / "state" / "loop_closer" / CONTENTS).unlink()
    claim(state)
    assert FolderStore(state / "state").load("loop_closer") is not None


def test_damaged_number_of_the_generation_is_replaced(state: Path) -> None:
    flip(state / "state" / MARKER)
    claim(state)
    assert completed_generation(FolderStore(state / "state")) is not None
    flip(newest_file(state, "tracker", "now"))
    claim(state)


def test_power_cut_before_the_first_generation_starts_with_an_empty_map(tmp_path: Path) -> None:
    claim(tmp_path)
    FolderStore(tmp_path / "state").save("tracker", {"now": [1]})
    cut(newest_file(tmp_path, "tracker", "now"))
    claim(tmp_path)
    assert FolderStore(tmp_path / "state").load("tracker") is None
