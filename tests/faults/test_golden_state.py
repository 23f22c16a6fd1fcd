"""Tests of state folders of earlier versions; `tests/storage/golden` has one per version."""

import asyncio
import tarfile
from pathlib import Path

import msgspec
import pytest

from ldo_service.runtime.generations import completed_generation
from ldo_service.storage.state_contents import STATE_VERSION, read_contents
from ldo_service.storage.state_store import CONTENTS, FolderStore

from .golden_state import GOLDEN, KEYFRAMES
from .small_service import ACTORS, open_service
from .test_state_damage import claim


@pytest.mark.parametrize("name", sorted(path.name for path in GOLDEN.glob("*.tar.xz")))
def test_state_of_an_earlier_version_continues(tmp_path: Path, name: str) -> None:
    with tarfile.open(GOLDEN / name) as archive:
        archive.extractall(tmp_path, filter="data")
    claim(tmp_path)
    assert completed_generation(FolderStore(tmp_path / "state")) is not None

    async def run() -> float:
        async with open_service(tmp_path) as service:
            await service.send_frame(KEYFRAMES)
            await service.wait_until_quiet()
            await service.stop()
            return service.metric("mapper", "keyframes")

    assert asyncio.run(run()) == KEYFRAMES + 1
    store = FolderStore(tmp_path / "state")
    contents = [read_contents(store.folder / actor / CONTENTS) for actor in ACTORS]
    assert {each.version for each in contents if each} == {STATE_VERSION}


def test_there_is_a_state_of_the_current_version() -> None:
    assert (GOLDEN / f"state-v{STATE_VERSION}.tar.xz").exists()


def test_version_3_can_read_that_the_state_has_a_later_version(tmp_path: Path) -> None:
    """Version 3 then refuses the state, and leaves the folder as it is."""

    class Contents(msgspec.Struct):
        files: dict[str, str]
        version: int

    FolderStore(tmp_path).save("mapper", {"step": [1]})
    body = (tmp_path / "mapper" / CONTENTS).read_bytes()
    assert msgspec.msgpack.decode(body, type=Contents).version == STATE_VERSION > 3
