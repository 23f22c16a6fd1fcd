"""Keys are made whole, kept secret, and never overwritten."""

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


def test_secrets_are_their_owners_alone(authority: CertificateAuthority) -> None:
    made = authority.add("front", "camera", "mule", days=7)
    assert mode(authority.folder) == mode(made) == 0o700
    assert mode(authority.folder / "ca.key") == mode(made / "tls.key") == 0o600
    assert sorted(path.name for path in made.iterdir()) == ["ca.crt", "tls.crt", "tls.key"]


def test_keys_hold_for_the_days_that_were_asked_for(authority: CertificateAuthority) -> None:
    noon = datetime(2030, 1, 1, 12, tzinfo=UTC)
    made = authority.add("front", "camera", "mule", days=7, now=noon)
    certificate = read_certificate((made / "tls.crt").read_bytes())
    assert certificate.not_valid_after_utc == noon + timedelta(days=7)
    assert authority.entries[0].grantee == AccessEntry("camera", "mule", date(2030, 1, 8))


def test_every_service_has_the_list_of_who_may_do_what(authority: CertificateAuthority) -> None:
    service = authority.add("mule", "service", "mule", days=7, hosts=["mule.local", "10.0.0.7"])
    authority.add("front", "camera", "mule", days=7)
    entries = {entry.common_name: entry.grantee for entry in authority.entries}
    assert read_access(service / "access.yaml") == entries
    assert read_access(authority.folder / "access.yaml") == entries
    assert CertificateAuthority(authority.folder).entries == authority.entries
    authority.remove("front")
    assert [who.role for who in read_access(service / "access.yaml").values()] == ["service"]


def test_keys_made_again_are_others(authority: CertificateAuthority) -> None:
    authority.add("front", "camera", "mule", days=7)
    (lost,) = authority.entries
    authority.remove("front")
    assert not (authority.folder / "front").exists()
    authority.add("front", "camera", "mule", days=7)
    (new,) = authority.entries
    assert (new.name, new.common_name != lost.common_name) == ("front", True)


def test_nothing_is_overwritten(authority: CertificateAuthority) -> None:
    made = authority.add("front", "camera", "mule", days=7)
    before = (made / "tls.key").read_bytes(), (authority.folder / "ca.key").read_bytes()
    for again in (
        lambda: authority.add("front", "viewer", "mule", days=7),
        lambda: authority.add("ca.key", "viewer", "mule", days=7),
        lambda: CertificateAuthority.new(authority.folder, days=7),
    ):
        with pytest.raises(ConfigError, match="never overwritten"):
            again()
    assert ((made / "tls.key").read_bytes(), (authority.folder / "ca.key").read_bytes()) == before
    assert len(authority.entries) == 1


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"days": 0}, "--days 0"),
        ({"days": 10**9}, "--days 1000000000"),
        ({"robot": "a/b"}, "robot name"),
        ({"hosts": ["mule"], "role": "camera"}, "--host needs the role service"),
        ({"hosts": ["mülé"], "role": "service"}, "--host mülé"),
    ],
)
def test_what_cannot_be_leaves_nothing_behind(
    authority: CertificateAuthority, fields, says: str
) -> None:
    wanted = {"name": "x", "role": "viewer", "robot": "*", "days": 7, **fields}
    with pytest.raises(ConfigError, match=says):
        authority.add(**wanted)
    assert sorted(path.name for path in authority.folder.iterdir()) == [
        "access.yaml",
        "ca.crt",
        "ca.key",
    ]


def test_a_folder_that_is_no_authority_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="ldo keys init"):
        CertificateAuthority(tmp_path)


def test_what_was_made_can_be_used(authority: CertificateAuthority) -> None:
    TlsKeys(authority.add("front", "camera", "mule", days=7)).context()
