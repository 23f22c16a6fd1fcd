"""Tests of key folders: an unusable folder is reported before a connection is opened."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
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


def test_complete_key_folder_is_accepted(folder: Path) -> None:
    settings = TlsKeys(folder).settings(router=True)
    assert settings["access_control"]["default_permission"] == "deny"
    assert "access_control" not in TlsKeys(folder).settings(router=False)


@pytest.mark.parametrize("name", ["ca.crt", "tls.crt", "tls.key"])
def test_missing_key_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=f"{name} cannot be read: No such file"):
        TlsKeys(folder)


def test_world_readable_secret_key_is_rejected(folder: Path) -> None:
    (folder / "tls.key").chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        TlsKeys(folder)
    (folder / "tls.key").chmod(0o640)  # Kubernetes mounts secrets for a group with this mode.
    TlsKeys(folder)


def replace_secret_key(folder: Path, authority: CertificateAuthority) -> None:
    other = authority.add("other", "viewer", "mule", days=1)
    (folder / "tls.key").write_bytes((other / "tls.key").read_bytes())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder, _: (folder / "ca.crt").write_text("no"), "ca.crt contains no certificate"),
        (lambda folder, _: (folder / "tls.crt").write_text("no"), "do not match"),
        (lambda folder, _: (folder / "tls.key").write_text("no"), "do not match"),
        (replace_secret_key, "do not match"),
    ],
    ids=["no authority", "no certificate", "no key", "another key"],
)
def test_damaged_keys_are_rejected(
    folder: Path,
    authority: CertificateAuthority,
    damage: Callable[[Path, CertificateAuthority], object],
    message: str,
) -> None:
    damage(folder, authority)
    with pytest.raises(ConfigError, match=message):
        TlsKeys(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("[", "is no valid access list"),
        ("x: {role: king, robot: mule}", "king"),
        ("x: {role: camera}", "robot"),
        ("x: {role: camera, robot: mule, may: all}", "may"),
        ("x: !!python/object/apply:os.system ['true']", "is no valid access list"),
    ],
)
def test_invalid_access_list_is_rejected(folder: Path, text: str | None, message: str) -> None:
    path = folder / "access.yaml"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_access(path)


@pytest.mark.parametrize(
    ("days", "warning"),
    [(31, ""), (29, "expires in 29.0 days"), (-1, "expired 1.0 days ago")],
)
def test_certificate_is_warned_of_during_the_30_days_before_it_expires(
    days: int, warning: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=60)
    made_at = datetime.now(UTC) + timedelta(days=days - 50)
    keys = TlsKeys(authority.add("mule", "service", "mule", days=50, now=made_at))
    keys.warn_of_expiry("Other machines cannot connect after that.")
    assert bool(caplog.records) == bool(warning)
    assert warning in caplog.text
