"""Endpoint of a robot: address of its router, key prefix of its topics, and TLS keys."""

import ipaddress
from dataclasses import dataclass

from ldo_service.errors import ConfigError
from ldo_service.schemas.topics import ROBOT_PREFIX

from .access_control import LOCAL
from .keys import TlsKeys

# Default address of HTTP servers. They have no access control: on another address, every machine on
# the network could see where the robot is.
LOOPBACK = "127.0.0.1"

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_PORT = 65_535
# Maximum size of a message. A 4K frame with depth in floats has 58 MB. Zenoh's default maximum is
# 1074 MB.
MAX_MESSAGE_MB = 128
CLOSED = {  # Zenoh settings, by path, that prevent connections of other programs.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,
}
NOT_IN_NAMES = "/*$?#@ "  # Characters with a meaning in Zenoh, and separators of topic parts.


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Name of a robot, address of its router, and TLS keys."""

    robot: str = "robot"  # Name of the robot.
    endpoint: str = DEFAULT_ENDPOINT  # Address of the router.
    keys: TlsKeys | None = None  # TLS keys; None for a connection without TLS.
    max_message_mb: int = MAX_MESSAGE_MB  # Receivers drop larger messages.
    # Path of a Unix socket on which a router with TLS keys also listens, for its own child
    # processes; empty if there is none. This link still works when the certificate has expired.
    local_socket: str = ""
    # Address on loopback, such as tls/127.0.0.1:40123, on which a router with TLS keys listens. Its
    # gate (`connection_gate`) listens on `endpoint` and passes connections on to this address.
    # Empty: there is no gate, and the router listens on `endpoint` itself.
    behind_gate: str = ""

    def __post_init__(self) -> None:
        require_robot(self.robot)
        port = self.address[1]
        if port.isdecimal() and int(port) > MAX_PORT:
            raise ConfigError(
                f"endpoint {self.endpoint} has the port {port}, which must be at most {MAX_PORT}. "
                "Choose another port."
            )
        is_tls = self.endpoint.startswith("tls/")
        if is_tls and self.keys is None:
            raise ConfigError(
                f"endpoint {self.endpoint} uses TLS and needs keys. Create keys with `ldo keys`, "
                "and give their folder with --keys."
            )
        if self.keys is not None and not is_tls:
            raise ConfigError(
                f"keys need a TLS endpoint, but the endpoint is {self.endpoint}. Write it as "
                "tls/ADDRESS:PORT."
            )

    def expression(self, key: str) -> str:
        """Return the Zenoh key expression of a topic or other key of this robot."""
        return f"{ROBOT_PREFIX}/{self.robot}/{key}"

    @property
    def address(self) -> tuple[str, str]:
        """Host and port of the endpoint; empty strings if it has none."""
        host, _, port = self.endpoint.partition("/")[2].rpartition(":")
        return host.strip("[]"), port

    @property
    def local_endpoint(self) -> str:
        """Address that processes on the same machine connect to."""
        if self.local_socket:
            return f"{LOCAL}/{self.local_socket}"
        reached = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.address[0])
        if reached is None:
            return self.endpoint
        return f"{self.endpoint.partition('/')[0]}/{reached}:{self.address[1]}"

    def require_safe(self) -> None:
        """Check that the endpoint is on loopback or protected by TLS.

        Raises:
            ConfigError: The endpoint is on another address and has no TLS. Every machine on the
                network could then read topics, publish messages and send commands.
        """
        is_local = self.endpoint.startswith(f"{LOCAL}/")
        if self.keys is None and not is_local and not _is_loopback(self.address[0]):
            raise ConfigError(
                f"endpoint {self.endpoint} would let every machine on the network read the map "
                "and control the robot. Use tls/ADDRESS:PORT with --keys (created by `ldo keys`), "
                "or --insecure on a private network."
            )


def require_robot(name: str) -> None:
    """Check the name of a robot.

    Raises:
        ConfigError: The name is empty or contains a reserved character.
    """
    if not name or any(c in name for c in NOT_IN_NAMES):
        raise ConfigError(
            f"robot name {name!r} is part of every topic: it must not be empty and must not "
            "contain any of / * $ ? # @ or a space."
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
