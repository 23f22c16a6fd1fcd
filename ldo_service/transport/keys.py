"""TLS keys of one machine, in a folder that `ldo keys` created.

- `ca.crt`: Certificate of the authority that the whole network trusts.
- `tls.crt`: Certificate of this machine. `access.yaml` of the router lists its role.
- `tls.key`: Private key, not readable by other users.
- `access.yaml`: Role of each certificate; only in the folder of a service or router.

The first three files are named as in a Kubernetes TLS secret, so a folder with a mounted secret
works too.
"""

import logging
import socket
import ssl
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ldo_service.errors import ConfigError

from .access_control import Access, access_control, read_access

log = logging.getLogger(__name__)

CA, CERTIFICATE, KEY, ACCESS = "ca.crt", "tls.crt", "tls.key", "access.yaml"
EXPIRY_WARNING_DAYS = 30  # Warnings are given during this time before a certificate expires.
DAY_S = 86_400
OTHERS = 0o007  # Bits of a file mode that give access to all users of the machine.
# Time limit for reading the TLS error of a server, seconds. A server rejects a client in the
# handshake or one round trip later.
ALERT_WITHIN_S = 1.0
OF_SERVICE = "Other machines cannot connect after that; actors on this machine continue."
OF_CLIENT = "This program cannot connect after that."


def expiry_warning(valid_until_s: float | None) -> str:
    """Return "expires in ... days" or "expired ... days ago" if a warning is due, else "".

    A warning is due if the certificate is valid for at most `EXPIRY_WARNING_DAYS` more days.

    Args:
        valid_until_s: End of the validity of a certificate, Unix time in seconds; None if unknown.
    """
    if valid_until_s is None:
        return ""
    days = (valid_until_s - time.time()) / DAY_S
    if days > EXPIRY_WARNING_DAYS:
        return ""
    return f"expires in {days:.1f} days" if days > 0 else f"expired {-days:.1f} days ago"


def router_settings(folder: Path, access: Access, local_robot: str = "") -> dict[str, Any]:
    """Return the Zenoh settings of a router, with the path of each setting as key.

    Args:
        folder: The folder with the TLS keys of the router.
        access: Role of each certificate.
        local_robot: Name of the robot if child processes of the service connect over a Unix socket;
            otherwise empty.
    """
    tls = {"transport/link/tls": _tls(folder, "listen")}
    return {**tls, "access_control": access_control(access, local_robot)}


def _tls(folder: Path, side: str) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(folder / CA),
        f"{side}_certificate": str(folder / CERTIFICATE),
        f"{side}_private_key": str(folder / KEY),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }


@dataclass(frozen=True, slots=True)
class TlsKeys:
    """Folder with TLS keys; the constructor checks its files."""

    folder: Path

    @classmethod
    def of(cls, folder: str | Path | None) -> "TlsKeys | None":
        """Return the keys in a folder; None if `folder` is None."""
        return None if folder is None else cls(Path(folder).expanduser().resolve())

    def __post_init__(self) -> None:
        """Check that the files are readable, the private key is protected, and the keys match.

        Raises:
            ConfigError: The folder cannot be used.
        """
        for name in (CA, CERTIFICATE, KEY):
            self._require_readable(self.folder / name)
        mode = (self.folder / KEY).stat().st_mode
        if mode & OTHERS:
            raise ConfigError(
                f"{self.folder / KEY} is readable by all users of this machine. Run "
                f"`chmod 600 {self.folder / KEY}`, and create new keys if another user has read "
                "the file."
            )
        self.context()

    def settings(self, router: bool, local_robot: str = "") -> dict[str, Any]:
        """Return the Zenoh settings of a router or a client, with the path of each setting as key.

        Args:
            router: True for a router, whose settings include the roles in `access.yaml`.
            local_robot: Name of the robot if child processes of the service connect over a Unix
                socket; otherwise empty.
        """
        if router:
            return router_settings(self.folder, read_access(self.folder / ACCESS), local_robot)
        return {"transport/link/tls": _tls(self.folder, "connect")}

    def valid_until_s(self) -> float | None:
        """Return the end of the certificate's validity, Unix time in seconds; None if unknown."""
        # The standard library has no other function that reads a certificate from a file.
        read = getattr(getattr(ssl, "_ssl", None), "_test_decode_cert", None)
        if read is None:
            return None
        return ssl.cert_time_to_seconds(read(str(self.folder / CERTIFICATE))["notAfter"])

    def warn_of_expiry(self, consequence: str) -> None:
        """Log a warning if the certificate has expired or expires within 30 days.

        Args:
            consequence: Sentence for the log: what happens after the certificate has expired.
        """
        if when := expiry_warning(self.valid_until_s()):
            log.warning(
                "The certificate %s %s by the clock of this machine. %s Run `ldo keys` for new "
                "keys, or set the clock.",
                self.folder / CERTIFICATE, when, consequence,
            )  # fmt: skip

    def context(self) -> ssl.SSLContext:
        """Create the TLS context of a client with these keys.

        Raises:
            ConfigError: A file is malformed, or certificate and key do not match.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            context.load_verify_locations(self.folder / CA)
        except ssl.SSLError as error:
            raise ConfigError(
                f"{self.folder / CA} contains no certificate. Copy the file again from the folder "
                "that `ldo keys` created."
            ) from error
        try:
            context.load_cert_chain(self.folder / CERTIFICATE, self.folder / KEY)
        except ssl.SSLError as error:
            raise ConfigError(
                f"{CERTIFICATE} and {KEY} in {self.folder} do not match "
                f"({error.reason or error}). Copy the whole folder again."
            ) from error
        return context

    def tls_error(self, host: str, port: int) -> str:
        """Connect to a server by TLS, and return the TLS error, or "" if there is none."""
        try:
            self._handshake(host, port)
        except ssl.SSLError as error:
            return getattr(error, "verify_message", "") or error.reason or str(error)
        except OSError:
            pass  # The server is absent, or reports no TLS error within the time limit.
        return ""

    def server_valid_until_s(self, host: str, port: int) -> float | None:
        """Return the end of the validity of a server's certificate, Unix time in seconds.

        The result is None if the server is absent, if the server rejects these keys, or if the
        certificate of the server is rejected.
        """
        try:
            return self._handshake(host, port)
        except OSError:
            return None

    def _handshake(self, host: str, port: int) -> float | None:
        """Connect to a server, and return the end of the validity of its certificate.

        Raises:
            OSError: The server is absent, or server and keys reject each other.
        """
        with (
            socket.create_connection((host, port), ALERT_WITHIN_S) as plain,
            self.context().wrap_socket(plain, server_hostname=host) as secured,
        ):
            certificate = secured.getpeercert() or {}
            # A server that rejects the keys says so after the handshake.
            with suppress(TimeoutError):
                secured.recv(1)
        until = certificate.get("notAfter")
        return ssl.cert_time_to_seconds(until) if isinstance(until, str) else None

    def _require_readable(self, path: Path) -> None:
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be read: {error.strerror}. --keys must name a folder that "
                f"`ldo keys` created, with {CA}, {CERTIFICATE} and {KEY}."
            ) from error
