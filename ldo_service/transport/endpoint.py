"""Where a robot's topics are, and by which keys one gets there."""

import ipaddress
from dataclasses import dataclass

from ldo_service.errors import ConfigError
from ldo_service.schemas.topics import ROBOT_PREFIX

from .keys import TlsKeys

LOOPBACK = "127.0.0.1"  # anyone who may read them may also see where the robot is at work

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
MAX_MESSAGE_MB = 128  # a 4K frame with depth in floats has 58 MB, Zenoh's default is 1074
CLOSED = {  # what Zenoh opens by default, by the paths of its settings
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,
}
NOT_IN_NAMES = "/*$?#@ "  # Zenoh's own, and what separates parts of a topic


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A robot, and the address of its router."""

    robot: str = "robot"
    endpoint: str = DEFAULT_ENDPOINT
    keys: TlsKeys | None = None
    max_message_mb: int = MAX_MESSAGE_MB  # larger ones are dropped where they arrive

    def __post_init__(self) -> None:
        require_robot(self.robot)
        is_tls = self.endpoint.startswith("tls/")
        if is_tls and self.keys is None:
            raise ConfigError(
                f"{self.endpoint} needs keys: `ldo keys` makes them, and --keys names their folder."
            )
        if self.keys is not None and not is_tls:
            raise ConfigError(
                f"keys are for TLS, and {self.endpoint} is not: write tls/ADDRESS:PORT."
            )

    def expression(self, key: str) -> str:
        return f"{ROBOT_PREFIX}/{self.robot}/{key}"

    @property
    def address(self) -> tuple[str, str]:
        """Host and port; empty where the endpoint has none."""
        host, _, port = self.endpoint.partition("/")[2].rpartition(":")
        return host.strip("[]"), port

    @property
    def local_endpoint(self) -> str:
        """Where a process on the same machine reaches who listens here."""
        reached = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.address[0])
        if reached is None:
            return self.endpoint
        return f"{self.endpoint.partition('/')[0]}/{reached}:{self.address[1]}"

    def require_safe(self) -> None:
        """Raises ConfigError where everybody on the network could listen, feed and control."""
        if self.keys is None and not _is_loopback(self.address[0]):
            raise ConfigError(
                f"on {self.endpoint} everybody on the network could read the map and control the "
                "robot. Use tls/ADDRESS:PORT with --keys (`ldo keys` makes them), or say "
                "--insecure where the network is yours alone."
            )


def require_robot(name: str) -> None:
    """Raises ConfigError for a name that is none."""
    if not name or any(c in name for c in NOT_IN_NAMES):
        raise ConfigError(
            f"robot name {name!r}: it becomes a part of every topic, so it must not be empty nor "
            "hold any of / * $ ? # @ or a space."
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
