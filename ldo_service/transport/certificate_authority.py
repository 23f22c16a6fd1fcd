"""Certificate authority of a network of robots: `ldo keys`.

The folder DIR of an authority contains:

- `DIR/ca.crt`, `DIR/ca.key`: Certificate and private key of the authority. No robot needs the
  private key, so it stays in this folder.
- `DIR/access.yaml`: Role of each certificate. The folder of each service has a copy.
- `DIR/<name>/`: Files for one machine: ca.crt, tls.crt, tls.key.

The common name of a certificate consists of the name of its keys and a random number. If removed
keys are created again under the same name, their common name therefore differs. Routers with the
new access list deny the old keys.
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
# Valid name, at most 55 characters. With the random number, a common name then has at most 64
# characters, the limit of X.509.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,54}")
HERE = ("localhost", "127.0.0.1", "::1")  # Addresses that the actors of a service connect to.
HEAD = "# Role of each certificate. `ldo keys` writes this file; routers read it at their start.\n"


@dataclass(frozen=True, slots=True)
class Entry:
    """Certificate that the authority issued."""

    name: str  # Name of the keys, which the user chose.
    common_name: str  # Common name in the certificate: the name of the keys and a random number.
    grantee: AccessEntry  # Role, robot and last valid day.


class CertificateAuthority:
    """Certificate authority in a folder that `CertificateAuthority.new` created."""

    def __init__(self, folder: Path) -> None:
        """Open the folder.

        Raises:
            ConfigError: The folder contains no authority.
        """
        self.folder = folder
        try:
            self._certificate = read_certificate((folder / CA).read_bytes())
            self._key = read_key((folder / CA_KEY).read_bytes())
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(
                f"{folder} contains no certificate authority ({why}). Create one in a new "
                "folder by `ldo keys init`."
            ) from error
        self._access = read_access(folder / ACCESS)

    @classmethod
    def new(cls, folder: Path, days: int) -> "CertificateAuthority":
        """Create an authority in a new folder.

        Args:
            folder: The folder to create.
            days: Validity of the authority's certificate, days.

        Raises:
            ConfigError: The folder exists already, or cannot be written.
        """
        if folder.exists():
            raise ConfigError(
                f"{folder} exists already, and keys are never overwritten. Choose a new folder."
            )
        key = new_key()
        certificate = of_authority(key, days, datetime.now(UTC))
        try:
            folder.mkdir(mode=0o700, parents=True)
            _write_secret(folder / CA_KEY, key_pem(key))
            (folder / CA).write_bytes(certificate_pem(certificate))
            write_atomically(folder / ACCESS, (HEAD + "{}\n").encode())
        except OSError as error:
            raise ConfigError(
                f"{folder} cannot be written: {error}. Choose another folder."
            ) from error
        return cls(folder)

    @property
    def entries(self) -> list[Entry]:
        """Issued certificates, sorted by common name."""
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
        """Issue new keys and add them to the access list.

        Args:
            name: Name of the keys, for example the name of the machine.
            role: Role of the certificate.
            robot: Name of the robot; EVERY_ROBOT for all robots.
            days: Validity of the certificate, days.
            hosts: Host names and IP addresses at which clients reach a service; empty for other
                roles.
            now: Start of the validity; the current time by default.

        Returns:
            Folder with the keys, to copy to the machine.

        Raises:
            ConfigError: An argument is invalid, the name is taken, or the folder cannot be written.
                The authority then stays unchanged.
        """
        _require_name(name)
        if robot != EVERY_ROBOT:
            require_robot(robot)
        if hosts and role != "service":
            raise ConfigError(
                f"--host needs the role service; a {role} accepts no connections. Omit --host."
            )
        _require_absent(self.folder / name)
        common_name = f"{name}-{secrets.token_hex(4)}"
        reached = (*HERE, *hosts) if role == "service" else ()
        certificate = self._make(name, common_name, days, reached, now or datetime.now(UTC))
        until = certificate.not_valid_after_utc.date()
        try:
            self._grant({**self._access, common_name: AccessEntry(role, robot, until)})
        except ConfigError:
            shutil.rmtree(self.folder / name, ignore_errors=True)
            raise
        return self.folder / name

    def remove(self, name: str) -> None:
        """Remove keys from the access list and delete their folder.

        Routers that start with the new list deny the keys.

        Raises:
            ConfigError: No keys have this name, or an access list cannot be written.
        """
        kept = {entry.common_name: entry.grantee for entry in self.entries if entry.name != name}
        if len(kept) == len(self._access):
            known = ", ".join(entry.name for entry in self.entries) or "none"
            raise ConfigError(
                f"{self.folder} has no keys named {name!r}. Choose one of its keys: {known}."
            )
        self._grant(kept)
        shutil.rmtree(self.folder / name, ignore_errors=True)  # The user may have moved the folder.

    def _make(
        self, name: str, common_name: str, days: int, hosts: Sequence[str], now: datetime
    ) -> Certificate:
        """Create key, certificate and their folder atomically; return the certificate."""
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
            raise ConfigError(
                f"{self.folder} cannot be written: {error}. Check its permissions and the free "
                "disk space."
            ) from error
        return certificate

    def _grant(self, access: dict[str, AccessEntry]) -> None:
        """Write the access list to the folder of every service, and last to this folder.

        Raises:
            ConfigError: A list cannot be written; the list of this folder is unchanged.
        """
        before, self._access = self._access, access
        text = HEAD + dump_yaml(msgspec.to_builtins(access))
        services = {entry.name for entry in self.entries if entry.grantee.role == "service"}
        for folder in (*(self.folder / name for name in sorted(services)), self.folder):
            if folder.is_dir():  # The user may have moved the folder of a service.
                try:
                    write_atomically(folder / ACCESS, text.encode())
                except OSError as error:
                    self._access = before
                    raise ConfigError(
                        f"{folder / ACCESS} cannot be written: {error.strerror}. Make it writable "
                        "or free some disk space, and repeat the command."
                    ) from error


def _require_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no valid name of keys. Use at most 55 letters, digits, '.', '-' and '_', "
            "and begin with a letter or digit."
        )


def _require_absent(path: Path) -> None:
    if path.exists():
        raise ConfigError(
            f"{path} exists already, and keys are never overwritten. Choose another name, or "
            "remove the old keys by `ldo keys remove`; routers then deny all copies of them."
        )


def _write_secret(path: Path, body: bytes) -> None:
    """Create a file that only its owner can read, and write the body to it."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(body)
