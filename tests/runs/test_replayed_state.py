"""Recordings of a service that continues from a saved state with a map."""

import asyncio
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from unittest.mock import patch

import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError
from ldo_service.gaussians.visibility import OffloadConfig
from ldo_service.recordings.recording import JournalFile
from ldo_service.runtime.journal import Started
from ldo_service.testing import replay_recording
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.runs.conftest import record_service

MAPPED, CONTINUED = 9, 4  # Frames before and after the restart.
CONFIG = load_config(
    settings=(
        "mapper.iterations=2",
        "tracker.keyframes.max_rotation_rad=0.02",  # A keyframe of almost every frame.
        "mapper.offload.max_resident_gaussians=2000",
    )
)


@pytest.fixture(scope="module", autouse=True)
def near_offloading() -> Iterator[None]:
    """Let mappers offload Gaussians in a small room, when recorded and when replayed."""
    offload = partial(OffloadConfig, reach_m=1.5, chunk_edge_m=0.5)
    with patch("ldo_service.config.parameters.OffloadConfig", offload):
        yield


@pytest.fixture(scope="module")
def continued(room: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a service that continues with a map; tests must not change it.

    The state from which it continued is gone, as on another machine.
    """
    folder = tmp_path_factory.mktemp("continued")
    state = folder / "state"
    asyncio.run(record_service(folder / "first", room, CONFIG, MAPPED, state=state))
    for kind in ("images", "gaussians"):
        assert len(list((state / "map" / kind).iterdir())) > 2
    later = record_service(folder / "second", room, CONFIG, CONTINUED, state=state, first=MAPPED)
    asyncio.run(later)
    shutil.rmtree(state)
    return folder / "second"


@pytest.fixture
def continued_copy(continued: Path, tmp_path: Path) -> Path:
    return shutil.copytree(continued, tmp_path / "copy")


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return the time of the last change and the bytes of each file."""
    return {str(p): (p.stat().st_mtime_ns, p.read_bytes()) for p in files_below(folder)}


def files_below(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def test_service_that_continues_with_a_map_replays(continued: Path) -> None:
    before = contents(continued)
    (mapper,) = replay_recording(continued, "mapper").values()
    assert (mapper.starts, mapper.restored, mapper.notes) == (1, 1, [])
    assert mapper.taken["keyframe/new"] > 1
    assert contents(continued) == before


def test_other_actors_replay_from_the_saved_state(continued: Path) -> None:
    replayed = replay_recording(continued, "tracker", "optimizer", "loop_closer")
    assert {report.restored for report in replayed.values()} == {1}


def test_copied_recording_replays(continued_copy: Path) -> None:
    replay_recording(continued_copy, "mapper")


def test_start_lists_images_and_offloaded_gaussians(continued: Path) -> None:
    start = next(JournalFile(continued / "mapper.mcap").entries())
    assert isinstance(start, Started)
    assert start.files is not None
    assert {name.split("/")[0] for name in start.files} == {"images", "gaussians"}
    kept = {path.name for path in (continued / "mapper.files").iterdir()}
    assert kept == {f"{name.replace('/', '.')}.{crc}" for name, crc in start.files.items()}


def test_missing_files_of_a_start_are_one_error(continued_copy: Path, capsys) -> None:
    shutil.rmtree(continued_copy / "mapper.files")
    code, _, err = ldo(capsys, "replay", continued_copy, "--actor", "mapper", "--verify")
    assert code == DataError.exit_code
    error = err[err.index("ldo: ") :]
    assert_one_paragraph(error)
    assert "mapper.files/images.00000000.keyframe" in error
    assert f"Copy the whole folder {continued_copy} again" in error


def test_changed_file_of_a_start_is_an_error(continued_copy: Path) -> None:
    path = next((continued_copy / "mapper.files").glob("gaussians.*"))
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(body)
    with pytest.raises(DataError, match=rf"{path.name} has changed: its checksum is \w+, but must"):
        replay_recording(continued_copy, "mapper")
