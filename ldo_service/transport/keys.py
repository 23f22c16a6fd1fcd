"""Keys of one name on the network, in a folder that `ldo keys` made.

    ca.crt        the authority that all of the network trust
    tls.crt       who this is; `access.yaml` of the router says what it may do
    tls.key       its secret, not readable by others
    access.yaml   of a service or a router: who may do what

The first three are named as in a secret of Kubernetes, so that such a folder will do as well.
"""

import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ldo_service.errors import ConfigError

from .access_control import Access, access_control, read_access

CA, CERTIFICATE, KEY, ACCESS = "ca.crt", "tls.crt", "tls.key", "access.yaml"
OTHERS = 0o007  # bits of a mode that let everybody on the machine in
ALERT_WITHIN_S = 1.0  # a refusal comes with the handshake, or one journey later


def router_settings(folder: Path, access: Access) -> dict[str, Any]:
    """Zenoh's settings by their paths, for a router with its keys in `folder`."""
    tls = {"transport/link/tls": _tls(folder, "listen")}
    return {**tls, "access_control": access_control(access)}


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
    folder: Path

    @classmethod
    def of(cls, folder: str | Path | None) -> "TlsKeys | None":
        return None if folder is None else cls(Path(folder).expanduser().resolve())

    def __post_init__(self) -> None:
        """Raises ConfigError for a folder that cannot be used."""
        for name in (CA, CERTIFICATE, KEY):
            self._require_readable(self.folder / name)
        mode = (self.folder / KEY).stat().st_mode
        if mode & OTHERS:
            raise ConfigError(
                f"{self.folder / KEY} may be read by everybody on this machine: "
                f"`chmod 600 {self.folder / KEY}`, and make new keys if somebody did."
            )
        self.context()

    def settings(self, router: bool) -> dict[str, Any]:
        """Zenoh's settings, for a router with an `access.yaml` or for a client."""
        if router:
            return router_settings(self.folder, read_access(self.folder / ACCESS))
        return {"transport/link/tls": _tls(self.folder, "connect")}

    def context(self) -> ssl.SSLContext:
        """A client with these keys. Raises ConfigError when they are none, or do not fit."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            context.load_verify_locations(self.folder / CA)
        except ssl.SSLError as error:
            raise ConfigError(f"{self.folder / CA} holds no certificate: copy it anew.") from error
        try:
            context.load_cert_chain(self.folder / CERTIFICATE, self.folder / KEY)
        except ssl.SSLError as error:
            raise ConfigError(
                f"{CERTIFICATE} and {KEY} in {self.folder} do not belong together "
                f"({error.reason or error}): copy the whole folder anew."
            ) from error
        return context

    def tls_error(self, host: str, port: int) -> str:
        """What TLS says of a server that Zenoh got no connection to; empty: nothing is wrong."""
        try:
            with (
                socket.create_connection((host, port), ALERT_WITHIN_S) as plain,
                self.context().wrap_socket(plain, server_hostname=host) as secured,
            ):
                secured.recv(1)
        except ssl.SSLError as error:
            return getattr(error, "verify_message", "") or error.reason or str(error)
        except OSError:
            pass  # nobody there, or nothing to say against us
        return ""

    def _require_readable(self, path: Path) -> None:
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be read: {error.strerror}. --keys names a folder that `ldo keys` "
                f"made, with {CA}, {CERTIFICATE} and {KEY}."
            ) from error
