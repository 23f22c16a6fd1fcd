"""Renewal of the TLS keys of a running router.

Zenoh reads the keys and the access list only when a session opens. Other programs connect to the
router of the service through the gate (`connection_gate`). If the files change, `KeyRenewal` opens
a second router with the new files. A Unix socket connects the second router to the router of the
service. The gate then closes the connections of the programs, and passes new connections on to the
second router. The programs connect again by themselves.
"""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread

import zenoh

from ldo_service.errors import ConfigError

from .endpoint import Endpoint
from .gate_process import GateProcess, free_port
from .keys import ACCESS, CA, CERTIFICATE, DAY_S, KEY, OF_SERVICE, TlsKeys
from .zenoh_transport import open_front_router

log = logging.getLogger(__name__)

Stamps = tuple[tuple[int, ...], ...]  # Number, time, size and access rights of each file.


class KeyRenewal:
    """Context manager whose thread watches the key files of a router and renews the keys.

    Once a day, the thread also logs a warning if the certificate expires soon.
    """

    # Time between two checks of the files, seconds. Changed files are read only after two checks
    # have found them equal, so that a copy is complete.
    PERIOD_S = 2.0

    def __init__(
        self, gate: GateProcess, network: Endpoint, on_renewed: Callable[[TlsKeys], None]
    ) -> None:
        """Remember the files as they are; the router must have read them just now.

        Args:
            gate: Process of the gate, which passes connections on to the router.
            network: Endpoint of the router, with keys and a Unix socket.
            on_renewed: Called with the new keys, on the thread of this object.
        """
        assert network.keys is not None
        self._gate, self._network, self._on_renewed = gate, network, on_renewed
        self._keys = network.keys
        self._used = self._seen = _stamps(self._keys.folder)
        self._front: zenoh.Session | None = None  # Router with renewed keys.
        self._warned_at_s = time.monotonic()
        self._closing = Event()
        self._thread = Thread(target=self._watch, name="key renewal", daemon=True)

    def __enter__(self) -> "KeyRenewal":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._close_front()

    def _watch(self) -> None:
        while not self._closing.wait(self.PERIOD_S):
            now = _stamps(self._keys.folder)
            is_complete, self._seen = now == self._seen, now
            try:
                if is_complete and now != self._used:
                    self._renew()
                    self._used = now
                if time.monotonic() - self._warned_at_s > DAY_S:
                    self._warned_at_s = time.monotonic()
                    self._keys.warn_of_expiry(OF_SERVICE)
            except Exception:  # The thread must look at the files again.
                log.exception("service: the keys in %s could not be renewed; trying again in %g s.",
                              self._keys.folder, self.PERIOD_S)  # fmt: skip

    def _renew(self) -> None:
        """Use the keys in the folder, unless they are invalid."""
        port = free_port()
        try:
            keys = TlsKeys(self._keys.folder)
            front = open_front_router(self._network, keys, port)
        except ConfigError as error:
            log.error(
                "service: the keys in %s changed but cannot be used, so the previous ones stay in "
                "use: %s",
                self._keys.folder, error,
            )  # fmt: skip
            return
        self._gate.redirect(port)
        self._close_front()
        self._front = front
        log.info("service: uses the new keys in %s; other machines connect again.", keys.folder)
        keys.warn_of_expiry(OF_SERVICE)
        self._on_renewed(keys)

    def _close_front(self) -> None:
        if self._front is not None:
            with suppress(zenoh.ZError):
                self._front.close()


def _stamps(folder: Path) -> Stamps:
    found = []
    for name in (CA, CERTIFICATE, KEY, ACCESS):
        try:
            status = (folder / name).stat()
            rights = (status.st_mode, status.st_uid, status.st_gid)
            found.append((status.st_ino, status.st_mtime_ns, status.st_size, *rights))
        except OSError:
            found.append(())
    return tuple(found)
