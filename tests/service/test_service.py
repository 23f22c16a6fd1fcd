"""Tests of the stages that a service creates, without starting them."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from ldo_service.actors.topology import actor_spec
from ldo_service.config import Config, load_config
from ldo_service.errors import DamagedStateError, UnavailableError
from ldo_service.runtime.generations import MARKER
from ldo_service.service import service as module
from ldo_service.service import state_folder
from ldo_service.service.service import Service
from ldo_service.service.state_folder import PAUSE_MARKER, RESET_MARKER
from ldo_service.storage.state_store import FolderStore
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.interface import MemoryTransport
from ldo_service.transport.zenoh_transport import ZenohTransport


def transport() -> ZenohTransport:
    """Return a network in memory, which suffices for stages that do not run."""
    return cast(ZenohTransport, MemoryTransport())


@pytest.mark.parametrize("is_remote", [True, False])
async def test_actor_on_another_machine_syncs_every_step_and_has_no_generations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_remote: bool
) -> None:
    stores: list[FolderStore] = []

    def stage(*_: object, store: FolderStore, **__: Any) -> None:
        stores.append(store)

    monkeypatch.setattr(module, "Stage", stage)
    network = Endpoint("robot", "tcp/127.0.0.1:1")
    service = Service(Config(), network, tmp_path, ("optimizer",), is_remote=is_remote)
    service._stage(actor_spec("optimizer"), transport(), {}, asyncio.Lock())
    assert [store.syncs for store in stores] == [is_remote]
    assert [store.has_generations for store in stores] == [not is_remote]


@pytest.mark.parametrize(
    ("marker", "expected"), [(PAUSE_MARKER, [True, False]), (RESET_MARKER, [True, True])]
)
async def test_pause_is_for_actors_that_take_frames_and_an_incomplete_reset_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, marker: str, expected: list[bool]
) -> None:
    are_paused: list[Callable[[], bool]] = []

    def stage(*_: object, starts_paused: Callable[[], bool], **__: Any) -> None:
        are_paused.append(starts_paused)

    monkeypatch.setattr(module, "Stage", stage)
    service = Service(Config(), Endpoint("robot", "tcp/127.0.0.1:1"), tmp_path)
    for actor in ("frame_source", "mapper"):
        service._stage(actor_spec(actor), transport(), {}, asyncio.Lock())
    assert [is_paused() for is_paused in are_paused] == [False, False]
    (tmp_path / marker).touch()
    assert [is_paused() for is_paused in are_paused] == expected


async def test_child_process_starts_on_a_full_disk_if_its_configuration_is_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    service = Service(Config(), Endpoint("robot", "tcp/127.0.0.1:1"), tmp_path)
    service._child(actor_spec("optimizer"), transport())
    before = (tmp_path / "config.yaml").read_text()
    monkeypatch.setattr(state_folder, "write_atomically", fill_disk)
    service._child(actor_spec("optimizer"), transport())
    changed = replace(service, config=load_config(settings=["mapper.iterations=7"]))
    with pytest.raises(UnavailableError, match=r"config\.yaml cannot be written: No space left"):
        changed._child(actor_spec("optimizer"), transport())
    assert (tmp_path / "config.yaml").read_text() == before


@pytest.mark.parametrize("is_state_kept", [True, False])
async def test_temporary_state_has_no_older_generations(
    tmp_path: Path, is_state_kept: bool
) -> None:
    network = Endpoint("robot", "tcp/127.0.0.1:1")
    service = Service(Config(), network, tmp_path, is_state_kept=is_state_kept)
    keeper = service._open_generations(transport())
    assert (keeper is not None) is is_state_kept
    (tmp_path / "state").mkdir()  # The start of a service does this.
    service._keep_last_generation()
    assert (tmp_path / "state" / MARKER).exists() is is_state_kept


def test_any_error_of_the_service_leaves_with_its_exit_code_while_a_step_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise DamagedStateError("a state is damaged")

    left: list[tuple[int, str]] = []
    monkeypatch.setattr(Service, "_serve", fail)
    monkeypatch.setattr(Service, "_open_session", lambda *_: None)
    monkeypatch.setattr(module, "_leave_if_busy", lambda *arguments: left.append(arguments))
    service = Service(Config(), Endpoint("robot", "tcp/127.0.0.1:1"), tmp_path)
    with pytest.raises(DamagedStateError):
        service.run()
    assert left == [(DamagedStateError.exit_code, "a state is damaged")]
