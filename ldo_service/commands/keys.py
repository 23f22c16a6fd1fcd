"""ldo keys"""

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

Folder = Annotated[
    Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR", help="folder of the authority")
]
Name = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME", help="of a program or a machine")
]
Days = Annotated[int, tyro.conf.arg(metavar="N", help="valid for so many days")]


@dataclass(frozen=True)
class New:
    """Make an authority in a new folder; nothing of it leaves this machine but what `add` makes."""

    folder: Folder
    days: Days = 3650


@dataclass(frozen=True)
class AddKeys:
    """Make keys: a folder to copy to the machine of that name, for --keys.

    ldo keys add DIR service mule --robot mule --host mule.local
    ldo keys add DIR camera front --robot mule

    Each service's folder gets the new list of who may do what: copy that too, and start it anew.
    """

    folder: Folder
    role: Annotated[
        Role,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="service|camera|odometry|viewer|operator", help="what it may do"),
    ]
    name: Name
    robot: Annotated[
        str, tyro.conf.arg(metavar="NAME", help="whose topics; otherwise those of every robot")
    ] = EVERY_ROBOT
    host: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="HOST",
            help="name or address where others reach a service, beside localhost; may be repeated",
        ),
    ] = ()
    days: Days = 365


@dataclass(frozen=True)
class ListKeys:
    """Show who has keys, what they may do and until when."""

    folder: Folder


@dataclass(frozen=True)
class RevokeKeys:
    """Let keys do nothing any more, and delete their folder here.

    That holds at a router that has the new `access.yaml` and was started anew.
    """

    folder: Folder
    name: Name


@dataclass(frozen=True)
class Router:
    """Print the configuration of a router of its own (`zenohd --config FILE`), for a fleet."""

    folder: Folder
    keys: Annotated[
        Path, tyro.conf.arg(metavar="DIR", help="where the router has its folder of keys")
    ] = Path("/etc/ldo/keys")
    port: Annotated[int, tyro.conf.arg(metavar="PORT", help="where it listens")] = 7447


Verb = (
    Annotated[New, tyro.conf.subcommand("init")]
    | Annotated[AddKeys, tyro.conf.subcommand("add")]
    | Annotated[ListKeys, tyro.conf.subcommand("list")]
    | Annotated[RevokeKeys, tyro.conf.subcommand("remove")]
    | Annotated[Router, tyro.conf.subcommand("router")]
)


def keys(verb: Verb) -> None:
    """Make and revoke the keys by which programs on the network know each other.

    Without keys the service listens on this machine alone:

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
            print(f"{verb.folder} is an authority: `ldo keys add` makes keys. ca.key stays here.")
        case AddKeys():
            authority = CertificateAuthority(verb.folder)
            made = authority.add(verb.name, verb.role, verb.robot, verb.days, verb.host)
            print(f"{made} is what {verb.name} needs: copy it there, for --keys.")
        case ListKeys():
            table = _table(CertificateAuthority(verb.folder))
            Console(highlight=False, markup=False, soft_wrap=True).print(table)
        case RevokeKeys():
            CertificateAuthority(verb.folder).remove(verb.name)
            print(
                f"{verb.name} may do nothing any more, where services have the new {ACCESS} and "
                "were started anew."
            )


def router_yaml(access: Access, folder: Path, port: int) -> str:
    """What makes `zenohd` do as a service's own router does."""
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
    table, today = Table("name", "may be", "of robot", "until"), datetime.now(UTC).date()
    for entry in authority.entries:
        who = entry.grantee
        until = "" if who.until is None else f"{who.until:%Y-%m-%d}"
        expired = " (expired)" if who.until and who.until < today else ""
        table.add_row(entry.name, who.role, who.robot, until + expired)
    return table
