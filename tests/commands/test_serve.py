"""Tests of the command `ldo serve`, without starting a service."""

from pathlib import Path
from typing import Any

import pytest

from ldo_service.commands import serve as module
from ldo_service.errors import ConfigError
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint


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


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    return CertificateAuthority.new(tmp_path / "keys", 2).add("mule", "service", "robot", 1)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Endpoint]:
    """Endpoints of the services that were opened."""
    opened: list[Endpoint] = []

    class Service:
        def __init__(self, _: object, network: Endpoint, *__: object, **___: Any) -> None:
            opened.append(network)

        def run(self) -> None:
            pass

    monkeypatch.setattr(module, "Service", Service)
    return opened


def serve_at(path: Path, keys: Path | None, client: bool = False) -> None:
    endpoint = f"{'tls' if keys else 'tcp'}/127.0.0.1:7447"
    module.serve(endpoint=endpoint, keys=keys, local_socket=path, client=client)


def test_local_socket_has_the_path_that_the_user_chose(
    tmp_path: Path, keys: Path, opened: list[Endpoint]
) -> None:
    tmp_path.chmod(0o750)  # The group of the folder may use the socket.
    serve_at(tmp_path / "link", keys)
    assert opened[0].local_endpoint == f"unixsock-stream/{tmp_path}/link"


@pytest.mark.parametrize(
    ("name", "mode", "error"),
    [
        ("link", 0o755, "all users of this machine can access"),
        ("absent/link", 0o700, "No such file or directory"),
        ("x" * 100, 0o700, "at most 107 bytes"),
        ("link#1", 0o700, "must not contain"),
    ],
    ids=["folder of all users", "no folder", "too long", "character"],
)
def test_unusable_local_socket_is_rejected(
    tmp_path: Path, keys: Path, opened: list[Endpoint], name: str, mode: int, error: str
) -> None:
    tmp_path.chmod(mode)
    with pytest.raises(ConfigError, match=error):
        serve_at(tmp_path / name, keys)
    assert not opened


def test_local_socket_without_keys_or_router_is_rejected(
    tmp_path: Path, keys: Path, opened: list[Endpoint]
) -> None:
    with pytest.raises(ConfigError, match="needs --keys"):
        serve_at(tmp_path / "link", None)
    with pytest.raises(ConfigError, match="opens its own router"):
        serve_at(tmp_path / "link", keys, client=True)
    assert not opened


def test_local_socket_does_not_replace_a_file(
    tmp_path: Path, keys: Path, opened: list[Endpoint]
) -> None:
    tmp_path.chmod(0o700)
    file = tmp_path / "notes.txt"
    file.write_text("kept")
    with pytest.raises(ConfigError, match="exists and is no socket"):
        serve_at(file, keys)
    assert not opened
    assert file.read_text() == "kept"
