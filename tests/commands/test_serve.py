"""Tests of the command `ldo serve`, without starting a service."""

from pathlib import Path
from typing import Any

import pytest

from ldo_service.commands import serve as module


@pytest.mark.parametrize(
    ("client", "actors", "is_remote", "is_router"),
    [
        (False, (), False, True),
        (False, ("tracker",), False, False),  # A child process.
        (True, (), False, False),  # A whole robot on the router of several robots.
        (True, ("optimizer",), True, False),
    ],
)
def test_only_single_actors_of_another_router_are_remote(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    client: bool,
    actors: tuple[str, ...],
    is_remote: bool,
    is_router: bool,
) -> None:
    opened: list[tuple[bool, bool]] = []

    class Service:
        def __init__(self, *_: object, is_remote: bool, is_router: bool, **__: Any) -> None:
            opened.append((is_remote, is_router))

        def run(self) -> None:
            pass

    monkeypatch.setattr(module, "Service", Service)
    module.serve(actor=actors, client=client, state=tmp_path / "state")
    assert opened == [(is_remote, is_router)]
