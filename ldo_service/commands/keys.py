"""Command `ldo keys`: create a certificate authority and keys for programs and machines."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from ldo_service.storage.yaml_io import dump_yaml
from ldo_service.transport.access_control import EVERY_ROBOT, Access, Role, read_access
from ldo_service.transport.endpoint import CLOSED, MAX_MESSAGE_MB
from ldo_service.transport.keys import ACCESS, router_settings

from .options import argument

Folder = Annotated[
    Path,
    tyro.conf.Positional,
    argument(metavar="DIR", help="folder of the certificate authority"),
]
Name = Annotated[
    str, tyro.conf.Positional, argument(metavar="NAME", help="name of a program or a machine")
]
Days = Annotated[int, argument(metavar="N", help="days that the keys are valid")]


@dataclass(frozen=True)
class New:
    """Create a certificate authority in a new folder.

    Keep the private key of the authority on this machine. Copy to other machines only the keys that
    `ldo keys add` makes.
    """

    folder: Folder
    days: Days = 3650


@dataclass(frozen=True)
class AddKeys:
    """Make the keys of the program NAME, in the folder DIR/NAME.

    Copy this folder to the machine of the program, and pass it to the program with --keys. The
    command also updates the access control list `access.yaml` in the folder of each service. Copy
    the new list into the key folder of each running service, which uses it within seconds. For a
    separate router, make a new configuration with `ldo keys router`, and restart the router.

      ldo keys add DIR service mule --robot mule --host mule.local
      ldo keys add DIR camera front --robot mule
    """

    folder: Folder
    role: Annotated[
        Role,
        tyro.conf.Positional,
        argument(
            metavar="service|camera|odometry|viewer|operator",
            help="role that limits what the program may do",
        ),
    ]
    name: Name
    robot: Annotated[
        str,
        argument(
            metavar="NAME", help="robot whose topics the program may use; default: every robot"
        ),
    ] = EVERY_ROBOT
    host: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="HOST",
            help="name or address of the machine of a service, in addition to localhost; may be "
            "repeated",
        ),
    ] = ()
    days: Days = 365


@dataclass(frozen=True)
class ListKeys:
    """List all keys with their roles, robots and expiry dates."""

    folder: Folder


@dataclass(frozen=True)
class RevokeKeys:
    """Revoke keys, and delete their folder on this machine.

    Copy the new `access.yaml` into the key folder of each running service, which then rejects the
    revoked keys within seconds. For a separate router, make a new configuration with
    `ldo keys router`, and restart the router.
    """

    folder: Folder
    name: Name


@dataclass(frozen=True)
class Router:
    """Print the configuration of a separate router (`zenohd --config FILE`), for a fleet."""

    folder: Folder
    keys: Annotated[
        Path, argument(metavar="DIR", help="folder of keys on the machine of the router")
    ] = Path("/etc/ldo/keys")
    port: Annotated[int, argument(metavar="PORT", help="port on which the router listens")] = 7447


Verb = (
    Annotated[New, tyro.conf.subcommand("init")]
    | Annotated[AddKeys, tyro.conf.subcommand("add")]
    | Annotated[ListKeys, tyro.conf.subcommand("list")]
    | Annotated[RevokeKeys, tyro.conf.subcommand("remove")]
    | Annotated[Router, tyro.conf.subcommand("router")]
)


def keys(verb: Verb) -> None:
    """Make and revoke the keys that authenticate programs on the network.

    A service without keys accepts only programs on its own machine. These commands make keys for a
    service and for a viewer on another machine, and start the service:

      ldo keys init DIR
      ldo keys add DIR service mule --host mule.local
      ldo keys add DIR viewer desk
      ldo serve --endpoint tls/0.0.0.0:7447 --keys DIR/mule
    """
    if isinstance(verb, Router):
        access = read_access(verb.folder / ACCESS)
        print(router_yaml(access, verb.keys, verb.port), end="")
        return
    from ldo_service.transport.certificate_authority import CertificateAuthority

    match verb:
        case New():
            CertificateAuthority.new(verb.folder, verb.days)
            print(
                f"{verb.folder} is a certificate authority: `ldo keys add` makes keys. Keep ca.key "
                "on this machine."
            )
        case AddKeys():
            authority = CertificateAuthority(verb.folder)
            made = authority.add(verb.name, verb.role, verb.robot, verb.days, verb.host)
            print(
                f"{made} has the keys of {verb.name}: copy this folder to the machine of "
                f"{verb.name}, and pass it there with --keys."
            )
        case ListKeys():
            table = _table(CertificateAuthority(verb.folder))
            Console(highlight=False, markup=False, soft_wrap=True).print(table)
        case RevokeKeys():
            CertificateAuthority(verb.folder).remove(verb.name)
            print(
                f"{verb.name} is revoked. Copy the new {ACCESS} into the key folder of every "
                "service: until then the keys remain valid there. For a separate router, run "
                "`ldo keys router` again, and restart the router."
            )


def router_yaml(access: Access, folder: Path, port: int) -> str:
    """Return a configuration that makes `zenohd` act like the router of a service.

    Args:
        access: The access control list.
        folder: Folder of keys on the machine of the router.
        port: Port on which the router listens.
    """
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tls/0.0.0.0:{port}"],
        **CLOSED,
        "transport/link/rx/max_message_size": MAX_MESSAGE_MB * 1_000_000,
        **router_settings(folder, access),
    }
    file: dict[str, Any] = {}
    for path, value in settings.items():
        *sections, last = path.split("/")
        section = file
        for name in sections:
            section = section.setdefault(name, {})
        section[last] = value
    return dump_yaml(file, flow=None, width=100)


def _table(authority: Any) -> Table:
    table, today = Table("name", "role", "robot", "valid until"), datetime.now(UTC).date()
    for entry in authority.entries:
        who = entry.grantee
        until = "" if who.until is None else f"{who.until:%Y-%m-%d}"
        expired = " (expired)" if who.until and who.until < today else ""
        table.add_row(entry.name, who.role, who.robot, until + expired)
    return table
