"""The small authority of a network's keys: `ldo keys`.

    DIR/ca.crt, ca.key    the authority; its secret stays in this folder and is needed on no robot
    DIR/access.yaml       who may do what; each service's folder has a copy
    DIR/<name>/           what goes to that machine: ca.crt, tls.crt, tls.key

A certificate's common name is its name and a number of its own: keys that were lost and made again
under the same name are two, and routers that know the new list let the old ones do nothing.
"""

import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from ldo_service.errors import ConfigError
from ldo_service.storage.atomic_write import folder_made_atomically, write_atomically
from ldo_service.storage.yaml_io import dump_yaml

from .access_control import EVERY_ROBOT, AccessEntry, Role, read_access
from .certificates import (
    Certificate,
    certificate_pem,
    key_pem,
    new_key,
    of_authority,
    of_member,
    read_certificate,
    read_key,
)
from .endpoint import require_robot
from .keys import ACCESS, CA, CERTIFICATE, KEY

CA_KEY = "ca.key"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,54}")  # with its number 64, a common name's most
HERE = ("localhost", "127.0.0.1", "::1")  # where a service's actors reach it
HEAD = "# Who may do what. `ldo keys` writes this; routers read it when they start.\n"


@dataclass(frozen=True, slots=True)
class Entry:
    """Keys that were given out."""

    name: str
    common_name: str
    grantee: AccessEntry


class CertificateAuthority:
    """Opened in a folder that `CertificateAuthority.new` made. Raises ConfigError for another
    one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self._certificate = read_certificate((folder / CA).read_bytes())
            self._key = read_key((folder / CA_KEY).read_bytes())
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(
                f"{folder} holds no authority ({why}): `ldo keys init` makes one, in a new folder."
            ) from error
        self._access = read_access(folder / ACCESS)

    @classmethod
    def new(cls, folder: Path, days: int) -> "CertificateAuthority":
        """Raises ConfigError when something is there already, which is left as it is."""
        if folder.exists():
            raise ConfigError(
                f"{folder} is there already, and keys are never overwritten: name a new folder."
            )
        key = new_key()
        certificate = of_authority(key, days, datetime.now(UTC))
        try:
            folder.mkdir(mode=0o700, parents=True)
            _write_secret(folder / CA_KEY, key_pem(key))
            (folder / CA).write_bytes(certificate_pem(certificate))
            write_atomically(folder / ACCESS, (HEAD + "{}\n").encode())
        except OSError as error:
            raise ConfigError(f"{folder} cannot be written: {error}.") from error
        return cls(folder)

    @property
    def entries(self) -> list[Entry]:
        rows = (Entry(cn.rpartition("-")[0], cn, who) for cn, who in self._access.items())
        return sorted(rows, key=lambda entry: entry.common_name)

    def add(
        self,
        name: str,
        role: Role,
        robot: str,
        days: int,
        hosts: Sequence[str] = (),
        now: datetime | None = None,
    ) -> Path:
        """The folder with new keys, to be copied to its machine.

        hosts  names and addresses where others reach it, of a service
        now    when the days begin; default: now

        Raises ConfigError for names that are none or taken; then nothing changes.
        """
        _require_name(name)
        if robot != EVERY_ROBOT:
            require_robot(robot)
        if hosts and role != "service":
            raise ConfigError(f"--host is of a service, and a {role} is reached by nobody.")
        _require_absent(self.folder / name)
        common_name = f"{name}-{secrets.token_hex(4)}"
        reached = (*HERE, *hosts) if role == "service" else ()
        certificate = self._make(name, common_name, days, reached, now or datetime.now(UTC))
        until = certificate.not_valid_after_utc.date()
        self._grant({**self._access, common_name: AccessEntry(role, robot, until)})
        return self.folder / name

    def remove(self, name: str) -> None:
        """Routers that get the new list let these keys do nothing.

        Raises ConfigError when there are none of this name.
        """
        kept = {entry.common_name: entry.grantee for entry in self.entries if entry.name != name}
        if len(kept) == len(self._access):
            known = ", ".join(entry.name for entry in self.entries) or "none"
            raise ConfigError(f"{self.folder} gave no keys to {name!r}; there are: {known}.")
        self._grant(kept)
        shutil.rmtree(self.folder / name, ignore_errors=True)  # it may have been moved away

    def _make(
        self, name: str, common_name: str, days: int, hosts: Sequence[str], now: datetime
    ) -> Certificate:
        """Key, certificate and their folder, whole or not at all."""
        key = new_key()
        certificate = of_member(
            self._certificate, self._key, common_name, key.public_key(), days, now, hosts
        )
        try:
            with folder_made_atomically(self.folder / name) as made:
                made.mkdir(mode=0o700)
                _write_secret(made / KEY, key_pem(key))
                (made / CERTIFICATE).write_bytes(certificate_pem(certificate))
                shutil.copyfile(self.folder / CA, made / CA)
        except OSError as error:
            raise ConfigError(f"{self.folder} cannot be written: {error}.") from error
        return certificate

    def _grant(self, access: dict[str, AccessEntry]) -> None:
        """Write the list, here and for every service."""
        self._access = access
        text = HEAD + dump_yaml(msgspec.to_builtins(access))
        services = {entry.name for entry in self.entries if entry.grantee.role == "service"}
        for folder in (self.folder, *(self.folder / name for name in sorted(services))):
            if folder.is_dir():  # a service's may have been moved away
                write_atomically(folder / ACCESS, text.encode())


def _require_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no name for keys: use letters, digits, '.', '-' and '_', at most 55, "
            "beginning with a letter or digit."
        )


def _require_absent(path: Path) -> None:
    if path.exists():
        raise ConfigError(
            f"{path} is there already, and keys are never overwritten: choose another name, or "
            "`ldo keys remove` it, after which those who have a copy can do nothing."
        )


def _write_secret(path: Path, body: bytes) -> None:
    """A new file that its owner alone may read, from the first byte on."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(body)
