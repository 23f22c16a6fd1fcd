"""A folder of keys that cannot be used is said before anything is opened."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ldo_service.errors import ConfigError
from ldo_service.transport.access_control import read_access
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.keys import TlsKeys


@pytest.fixture
def authority(tmp_path: Path) -> CertificateAuthority:
    return CertificateAuthority.new(tmp_path / "keys", days=2)


@pytest.fixture
def folder(authority: CertificateAuthority) -> Path:
    return authority.add("mule", "service", "mule", days=1)


def test_a_whole_folder_is_taken(folder: Path) -> None:
    settings = TlsKeys(folder).settings(router=True)
    assert settings["access_control"]["default_permission"] == "deny"
    assert "access_control" not in TlsKeys(folder).settings(router=False)


@pytest.mark.parametrize("name", ["ca.crt", "tls.crt", "tls.key"])
def test_what_is_missing_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=f"{name} cannot be read: No such file"):
        TlsKeys(folder)


def test_a_secret_that_everybody_may_read_is_refused(folder: Path) -> None:
    (folder / "tls.key").chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        TlsKeys(folder)
    (folder / "tls.key").chmod(0o640)  # as Kubernetes mounts secrets for a group
    TlsKeys(folder)


def of_another(folder: Path, authority: CertificateAuthority) -> None:
    other = authority.add("other", "viewer", "mule", days=1)
    (folder / "tls.key").write_bytes((other / "tls.key").read_bytes())


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda folder, _: (folder / "ca.crt").write_text("no"), "ca.crt holds no certificate"),
        (lambda folder, _: (folder / "tls.crt").write_text("no"), "do not belong together"),
        (lambda folder, _: (folder / "tls.key").write_text("no"), "do not belong together"),
        (of_another, "do not belong together"),
    ],
    ids=["no authority", "no certificate", "no key", "another key"],
)
def test_damaged_keys_are_refused(
    folder: Path,
    authority: CertificateAuthority,
    damage: Callable[[Path, CertificateAuthority], object],
    says: str,
) -> None:
    damage(folder, authority)
    with pytest.raises(ConfigError, match=says):
        TlsKeys(folder)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "cannot be read"),
        ("[", "is no valid access list"),
        ("x: {role: king, robot: mule}", "king"),
        ("x: {role: camera}", "robot"),
        ("x: {role: camera, robot: mule, may: all}", "may"),
        ("x: !!python/object/apply:os.system ['true']", "is no valid access list"),
    ],
)
def test_a_list_that_does_not_say_who_may_do_what_is_refused(
    folder: Path, text: str | None, says: str
) -> None:
    path = folder / "access.yaml"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        read_access(path)
