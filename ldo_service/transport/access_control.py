"""Access control of Zenoh, derived from the topics and the role of each certificate.

| role       | permissions                                            |
|------------|--------------------------------------------------------|
| `service`  | Performs all operations on all topics of its robot.    |
| `camera`   | Publishes camera frames.                               |
| `odometry` | Publishes odometry priors.                             |
| `viewer`   | Reads every topic.                                     |
| `operator` | Reads every topic; sends commands, refine requests     |
|            | and label names.                                       |

A client whose certificate is not in `access.yaml` may connect, but the router denies all messages
of this client. A key with wildcards may match some topics that a role may not use. The router then
denies the whole request. A viewer that subscribes to `ldo/robot/**` therefore receives nothing. It
must subscribe to topics by name.

`access.yaml` maps the common name of each certificate to its role, robot and last valid day:

    front-3f9a1c02: {role: camera, robot: mule, until: 2027-11-22}
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Literal

import msgspec
import yaml

from ldo_service.errors import ConfigError
from ldo_service.schemas.topics import (
    CONTROL,
    FROM_ODOMETRY,
    FROM_OPERATORS,
    FROM_OUTSIDE,
    ROBOT_PREFIX,
    TOPICS,
    Topic,
)
from ldo_service.storage.yaml_io import load_yaml

from .flow_control import ALIVE

LOCAL = "unixsock-stream"  # Zenoh's name of the protocol of Unix sockets.

Role = Literal["service", "camera", "odometry", "viewer", "operator"]
PUTS: dict[Role, Sequence[Topic]] = {
    "camera": FROM_OUTSIDE,
    "odometry": FROM_ODOMETRY,
    "operator": FROM_OPERATORS,
}
READERS: tuple[Role, ...] = ("viewer", "operator")
CONTROLLERS: tuple[Role, ...] = ("operator",)
READABLE = tuple(topic for topic in TOPICS if topic is not CONTROL)
EVERY_ROBOT = "*"
EVERYTHING = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)


class AccessEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Role, robot and last valid day of one certificate."""

    role: Role
    robot: str  # Name of the robot; EVERY_ROBOT for all robots.
    until: date | None = None  # Last day of the certificate.


Access = Mapping[str, AccessEntry]  # Entry by common name of the certificate.


def read_access(path: Path) -> dict[str, AccessEntry]:
    """Read the role of each certificate from `access.yaml`.

    Raises:
        ConfigError: The file cannot be read or is malformed.
    """
    try:
        return msgspec.convert(load_yaml(path.read_bytes()), dict[str, AccessEntry])
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}. Copy the file again from the folder that "
            "`ldo keys` wrote for this service."
        ) from error
    except (ValueError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path} is no valid access list: {error}. Replace it by the file that "
            "`ldo keys` writes."
        ) from error


def access_control(access: Access, local_robot: str = "") -> dict[str, Any]:
    """Return the section `access_control` of a router's Zenoh configuration.

    Args:
        access: Role of each certificate.
        local_robot: Name of the robot if child processes of the service connect over a Unix socket;
            otherwise empty. These processes may perform all operations, because only the user who
            runs the service can open the socket.
    """
    parts: dict[tuple[Role, str], list[str]] = {}
    for name, grantee in sorted(access.items()):
        parts.setdefault((grantee.role, grantee.robot), []).append(name)
    rules, subjects, policies = [], [], []
    for (role, robot), names in parts.items():
        part = f"{role} of {robot}"
        of_part = [rule.for_robot(robot, part) for rule in rules_of(role)]
        rules += of_part
        subjects.append({"id": part, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in of_part], "subjects": [part]})
    if local_robot:
        (rule,) = (rule.for_robot(local_robot, "this machine") for rule in rules_of("service"))
        rules.append(rule)
        subjects.append({"id": "this machine", "link_protocols": [LOCAL]})
        policies.append({"rules": [rule["id"]], "subjects": ["this machine"]})
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **lists}


@dataclass(frozen=True, slots=True)
class Rule:
    """Access rule that allows some kinds of Zenoh messages on some keys.

    Messages from a client to the router are "ingress". Messages from the router to a client are
    "egress".
    """

    name: str  # Name of the rule, part of its id.
    flows: tuple[str, ...]  # "ingress", "egress" or both.
    messages: tuple[str, ...]  # Kinds of Zenoh messages, such as "put" and "query".
    keys: tuple[str, ...]  # Zenoh key expressions, relative to the robot.

    def for_robot(self, robot: str, part: str) -> dict[str, Any]:
        """Return the rule for a robot in Zenoh's format; `part` is the prefix of the rule's id."""
        return {
            "id": f"{part}: {self.name}",
            "permission": "allow",
            "flows": list(self.flows),
            "messages": list(self.messages),
            "key_exprs": [f"{ROBOT_PREFIX}/{robot}/{key}" for key in self.keys],
        }


def rules_of(role: Role) -> Iterator[Rule]:
    """Yield the access rules of a role."""
    if role == "service":
        yield Rule("all operations", ("ingress", "egress"), EVERYTHING, ("**",))
    if role in PUTS:
        keys = tuple(topic.name for topic in PUTS[role])
        yield Rule("publish", ("ingress",), ("put",), keys)
        yield Rule("receive subscriptions", ("egress",), ("declare_subscriber",), keys)
    if role in READERS:
        yield from _rules_of_readers()
    if role in CONTROLLERS:
        yield Rule("send commands", ("ingress",), ("query",), (CONTROL.name,))
        yield Rule(
            "receive command replies", ("egress",), ("reply", "declare_queryable"), (CONTROL.name,)
        )


def _rules_of_readers() -> Iterator[Rule]:
    topics = tuple(topic.subscription_key for topic in READABLE)
    states = tuple(topic.name for topic in READABLE if topic.is_state)
    tokens = (f"{ALIVE}/*",)
    yield Rule("subscribe", ("ingress",), ("declare_subscriber",), topics)
    yield Rule("receive messages", ("egress",), ("put",), topics)
    yield Rule("query", ("ingress",), ("query",), states)
    yield Rule("receive query replies", ("egress",), ("reply", "declare_queryable"), states)
    liveliness_messages = ("liveliness_query", "declare_liveliness_subscriber")
    yield Rule("query liveliness", ("ingress",), liveliness_messages, tokens)
    yield Rule("receive liveliness", ("egress",), ("liveliness_token",), tokens)
