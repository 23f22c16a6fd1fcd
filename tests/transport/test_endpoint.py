"""Tests of endpoints: by default the service communicates only within this machine."""

import socket
from pathlib import Path

import pytest

from ldo_service.errors import ConfigError
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_port


def listening_sockets() -> list[tuple[str, int, str]]:
    """Return address, port and kind of each listening socket of this process, from `/proc`."""
    inodes = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            inodes.add(link.readlink().name.removeprefix("socket:[").rstrip("]"))
        except OSError:  # The file was closed in the meantime.
            continue
    found = []
    for kind, listening in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/self/net/{kind}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == listening and words[9] in inodes:
                address, port = words[1].split(":")
                found.append((address, int(port, 16), kind))
    return found


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="needs Linux' /proc")
def test_router_listens_on_loopback_only_and_does_not_scout() -> None:
    before = listening_sockets()
    network = Endpoint("test", f"tcp/127.0.0.1:{free_port()}")
    with open_session(network, router=True):
        opened = [one for one in listening_sockets() if one not in before]
    loopback = socket.inet_aton("127.0.0.1")[::-1].hex().upper()
    assert opened == [(loopback, int(network.address[1]), "tcp")]


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "tcp/127.1.2.3:1"]
)
def test_loopback_needs_no_keys(endpoint: str) -> None:
    Endpoint("mule", endpoint).require_safe()


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/mule.local:7447", "udp/10.0.0.7:7447"]
)
def test_network_endpoint_without_keys_is_rejected(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="every machine on the network"):
        Endpoint("mule", endpoint).require_safe()


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:65536", "tcp/[::1]:99999"])
def test_port_out_of_range_is_rejected(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="must be at most 65535"):
        Endpoint("mule", endpoint)


def test_keys_and_tls_require_each_other(tmp_path: Path) -> None:
    keys = TlsKeys(
        CertificateAuthority.new(tmp_path / "keys", days=2).add("mule", "service", "mule", days=1)
    )
    with pytest.raises(ConfigError, match="needs keys"):
        Endpoint("mule", "tls/0.0.0.0:7447")
    with pytest.raises(ConfigError, match="Write it as tls/"):
        Endpoint("mule", "tcp/0.0.0.0:7447", keys)
    Endpoint("mule", "tls/0.0.0.0:7447", keys).require_safe()


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"),
        ("tcp/[::]:7447", "tcp/[::1]:7447"),
        ("tcp/10.0.0.7:7447", "tcp/10.0.0.7:7447"),
    ],
)
def test_local_endpoint_is_an_address_the_service_listens_on(endpoint: str, local: str) -> None:
    assert Endpoint("mule", endpoint).local_endpoint == local
