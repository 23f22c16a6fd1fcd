"""Which state folders a service goes on from."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from ldo_service.actors.mapper import Mapper
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.errors import ConfigError, DataError
from ldo_service.service.state_folder import claim_state
from ldo_service.storage.state_store import CONTENTS, FolderStore

ACTORS = {"tracker": Tracker, "mapper": Mapper, "optimizer": Optimizer}


def saved(folder: Path, keyframes_made: int, *actors: str) -> Path:
    """As stages leave it that have seen no frame, or whose tracker has made keyframes."""
    for name in actors:
        out = {"keyframe/new": (1, keyframes_made)} if name == "tracker" else {}
        state = {**ACTORS[name]().snapshot(), "stage.offsets": {"in": {}, "out": out}}
        FolderStore(folder / "state").save(name, state)
    return folder


def claim(folder: Path) -> None:
    with ExitStack() as stack:
        claim_state(folder, stack)


def test_a_service_that_saw_no_keyframe_is_gone_on_from(tmp_path: Path) -> None:
    claim(saved(tmp_path, 0, *ACTORS))


@pytest.mark.parametrize("actors", [(), ("optimizer",), ("tracker", "mapper")])
def test_so_is_one_that_was_killed_while_it_started(tmp_path: Path, actors: tuple) -> None:
    claim(saved(tmp_path, 0, *actors))


@pytest.mark.parametrize("missing", ["mapper", "optimizer"])
def test_one_that_lost_a_part_of_a_journey_is_refused(tmp_path: Path, missing: str) -> None:
    saved(tmp_path, 5, *(name for name in ACTORS if name != missing))
    with pytest.raises(ConfigError, match=f"no readable state of {missing}, but"):
        claim(tmp_path)


def test_one_that_the_disk_does_not_let_be_read_is_left_as_it_is(tmp_path: Path) -> None:
    saved(tmp_path, 5, *ACTORS)
    contents = tmp_path / "state" / "mapper" / CONTENTS
    body = contents.read_bytes()
    contents.unlink()
    contents.mkdir()  # which fails to be read, whoever asks
    with pytest.raises(DataError, match=r"the state of mapper in .* cannot be read"):
        claim(tmp_path)
    contents.rmdir()
    contents.write_bytes(body)
    claim(tmp_path)


def test_one_whose_tracker_is_of_an_older_copy_is_refused(tmp_path: Path) -> None:
    """The mapper would take new keyframes for old ones that came again."""
    saved(tmp_path, 5, *ACTORS)
    had = {"in": {"keyframe/new": (1, 6)}, "out": {}}
    state = {**Mapper().snapshot(), "stage.offsets": had}
    FolderStore(tmp_path / "state").save("mapper", state)
    with pytest.raises(ConfigError, match="mapper is newer than that of tracker"):
        claim(tmp_path)
