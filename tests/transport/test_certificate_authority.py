"""Tests of key creation: keys are complete, secret and never overwritten."""

import stat
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import pytest

from ldo_service.errors import ConfigError
from ldo_service.transport.access_control import AccessEntry, read_access
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.certificates import read_certificate
from ldo_service.transport.keys import TlsKeys


@pytest.fixture
def authority(tmp_path: Path) -> CertificateAuthority:
    return CertificateAuthority.new(tmp_path / "keys", days=30)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_secret_keys_are_readable_by_their_owner_only(authority: CertificateAuthority) -> None:
    made = authority.add("front", "camera", "mule", days=7)
    assert mode(authority.folder) == mode(made) == 0o700
    assert mode(authority.folder / "ca.key") == mode(made / "tls.key") == 0o600
    assert sorted(path.name for path in made.iterdir()) == ["ca.crt", "tls.crt", "tls.key"]


def test_certificate_is_valid_for_the_requested_days(authority: CertificateAuthority) -> None:
    noon = datetime(2030, 1, 1, 12, tzinfo=UTC)
    made = authority.add("front", "camera", "mule", days=7, now=noon)
    certificate = read_certificate((made / "tls.crt").read_bytes())
    assert certificate.not_valid_after_utc == noon + timedelta(days=7)
    assert authority.entries[0].grantee == AccessEntry("camera", "mule", date(2030, 1, 8))


def test_access_list_of_each_service_holds_all_entries(authority: CertificateAuthority) -> None:
    service = authority.add("mule", "service", "mule", days=7, hosts=["mule.local", "10.0.0.7"])
    authority.add("front", "camera", "mule", days=7)
    entries = {entry.common_name: entry.grantee for entry in authority.entries}
    assert read_access(service / "access.yaml") == entries
    assert read_access(authority.folder / "access.yaml") == entries
    assert CertificateAuthority(authority.folder).entries == authority.entries
    authority.remove("front")
    assert [grantee.role for grantee in read_access(service / "access.yaml").values()] == [
        "service"
    ]


def test_failed_write_of_an_access_list_leaves_the_authority_unchanged(
    authority: CertificateAuthority,
) -> None:
    of_service = authority.add("mule", "service", "mule", days=7) / "access.yaml"
    before = read_access(authority.folder / "access.yaml")
    of_service.unlink()
    of_service.mkdir()  # A file cannot replace a folder.
    with pytest.raises(ConfigError, match=f"{of_service} cannot be written"):
        authority.add("front", "camera", "mule", days=7)
    assert read_access(authority.folder / "access.yaml") == before
    with pytest.raises(ConfigError, match="no keys named 'front'"):
        authority.remove("front")
    of_service.rmdir()
    authority.add("front", "camera", "mule", days=7)
    assert [entry.name for entry in authority.entries] == ["front", "mule"]


def test_recreated_keys_get_a_new_common_name(authority: CertificateAuthority) -> None:
    authority.add("front", "camera", "mule", days=7)
    (old,) = authority.entries
    authority.remove("front")
    assert not (authority.folder / "front").exists()
    authority.add("front", "camera", "mule", days=7)
    (new,) = authority.entries
    assert (new.name, new.common_name != old.common_name) == ("front", True)


def test_existing_keys_are_never_overwritten(authority: CertificateAuthority) -> None:
    made = authority.add("front", "camera", "mule", days=7)
    before = (made / "tls.key").read_bytes(), (authority.folder / "ca.key").read_bytes()
    for create in (
        lambda: authority.add("front", "viewer", "mule", days=7),
        lambda: authority.add("ca.key", "viewer", "mule", days=7),
        lambda: CertificateAuthority.new(authority.folder, days=7),
    ):
        with pytest.raises(ConfigError, match="never overwritten"):
            create()
    assert ((made / "tls.key").read_bytes(), (authority.folder / "ca.key").read_bytes()) == before
    assert len(authority.entries) == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"days": 0}, "--days 0"),
        ({"days": 10**9}, "--days 1000000000"),
        ({"robot": "a/b"}, "robot name"),
        ({"hosts": ["mule"], "role": "camera"}, "--host needs the role service"),
        ({"hosts": ["mülé"], "role": "service"}, "--host mülé"),
    ],
)
def test_invalid_request_leaves_no_files(
    authority: CertificateAuthority, fields, message: str
) -> None:
    request = {"name": "x", "role": "viewer", "robot": "*", "days": 7, **fields}
    with pytest.raises(ConfigError, match=message):
        authority.add(**request)
    assert sorted(path.name for path in authority.folder.iterdir()) == [
        "access.yaml",
        "ca.crt",
        "ca.key",
    ]


def test_folder_without_authority_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="ldo keys init"):
        CertificateAuthority(tmp_path)


def test_created_keys_load_into_a_tls_context(authority: CertificateAuthority) -> None:
    TlsKeys(authority.add("front", "camera", "mule", days=7)).context()
