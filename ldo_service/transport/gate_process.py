"""Process of the gate in front of the TLS port of a router; see `connection_gate`."""

import logging
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock, Thread

from ldo_service.errors import UnavailableError

from . import connection_gate
from .endpoint import LOOPBACK, Endpoint
from .zenoh_transport import MAX_SESSIONS, why_not_listening

log = logging.getLogger(__name__)

# Time for the gate of a killed service to free its port, seconds.
BIND_WITHIN_S = 3.0
RESTART_AFTER_S = 0.5  # Time before a gate that has ended is started again, seconds.
# The gate admits as many connections as the router has sessions. With a low limit of open files,
# it leaves three quarters of the descriptors of the service to other uses, saving among them.
DESCRIPTORS_PER_CONNECTION = 4


@contextmanager
def guarded(network: Endpoint) -> Iterator[tuple[Endpoint, "GateProcess | None"]]:
    """Open a context in which a gate runs in front of a router with TLS keys.

    The gate limits the connections of programs without keys; see `connection_gate`.

    Args:
        network: Endpoint to which clients connect. The gate listens on this endpoint, and passes
            connections on to a loopback port of the router.

    Yields:
        The endpoint with the loopback port on which the router must listen, and the gate. If
        settings such as `#iface=eth0` follow the port of the endpoint, no gate runs. The result is
        then `network` and None.

    Raises:
        UnavailableError: The address is in use or does not exist.
    """
    host, port = network.address
    if not port.isdecimal():  # The address has settings of Zenoh, such as `#iface=eth0`.
        log.warning(
            "service: the endpoint %s is no plain tls/ADDRESS:PORT, so connections without keys "
            "are not limited. Remove what follows the port.",
            network.endpoint,
        )
        yield network, None
        return
    with _listen(network, host, int(port)) as listener:
        port = free_port()
        gate = GateProcess(listener, port)
        try:
            yield replace(network, behind_gate=f"tls/{LOOPBACK}:{port}"), gate
        finally:
            gate.close()


class GateProcess:
    """Process of the gate in front of a router; the process is started again when it ends."""

    def __init__(self, listener: socket.socket, router_port: int) -> None:
        """Start the process.

        Args:
            listener: Listening socket of the gate.
            router_port: Port of the router on loopback.
        """
        self._router_port = router_port
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._max_connections = min(MAX_SESSIONS, soft // DESCRIPTORS_PER_CONNECTION)
        self._listener = listener
        self._closing = Event()
        self._lock = Lock()  # Held while a process is started or gets another port.
        self._process = self._start()
        self._watch = Thread(target=self._restart, name="gate", daemon=True)
        self._watch.start()

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def redirect(self, router_port: int) -> None:
        """Close all connections, and pass new ones on to another port of the router."""
        with self._lock:
            self._router_port = router_port
            stdin = self._process.stdin
            assert stdin is not None
            # A process that has ended is started again with the new port; its input may be closed.
            # A buffer would keep the line, and closing the input would fail because of it.
            with suppress(OSError, ValueError):
                os.write(stdin.fileno(), f"{router_port}\n".encode())

    def close(self) -> None:
        """End the process."""
        self._closing.set()
        self._process.kill()
        self._watch.join()

    def _start(self) -> subprocess.Popen[str]:
        limits = str(self._router_port), str(self._max_connections)
        return subprocess.Popen(
            (
                *(sys.executable, "-I", str(Path(connection_gate.__file__))),
                *(str(self._listener.fileno()), LOOPBACK, *limits),
            ),
            pass_fds=(self._listener.fileno(),),
            stdin=subprocess.PIPE,  # It ends with this process, and the gate with it.
            stdout=subprocess.PIPE,
            process_group=0,
            text=True,
        )

    def _restart(self) -> None:
        """Log the reports of the process, and start it again when it ends."""
        while True:
            with self._process as process:
                assert process.stdout is not None
                for count in process.stdout:
                    log.warning(
                        "service: closed %s connections of programs that showed no keys within "
                        "%.0f s, or too many of them. Programs with keys are not affected. If this "
                        "goes on, look for the sender in the network, or close the port to it by "
                        "a firewall.",
                        count.strip(), connection_gate.HANDSHAKE_S,
                    )  # fmt: skip
            if self._closing.wait(RESTART_AFTER_S):
                return
            log.error(
                "service: the gate of the TLS port ended with %s and is started again; other "
                "machines connect again by themselves.",
                process.returncode,
            )
            while not self._start_again():
                if self._closing.wait(RESTART_AFTER_S):
                    return
            if self._closing.is_set():
                self._process.kill()

    def _start_again(self) -> bool:
        """Start the process, and return whether the machine had the memory and descriptors."""
        try:
            with self._lock:
                self._process = self._start()
        except OSError as error:
            log.error("service: the gate of the TLS port cannot be started: %s; trying again.",
                      error.strerror)  # fmt: skip
            return False
        return True


def _listen(network: Endpoint, host: str, port: int) -> socket.socket:
    until_s = time.monotonic() + BIND_WITHIN_S
    while True:
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            family, *_, address = found[0]
            is_any = family == socket.AF_INET6 and address[0] == "::"
            dual = is_any and socket.has_dualstack_ipv6()
            return socket.create_server(address[:2], family=family, dualstack_ipv6=dual)
        except OSError as error:
            if time.monotonic() > until_s:
                raise UnavailableError(f"{why_not_listening(network)} ({error.strerror})") from None
            time.sleep(0.1)


def free_port() -> int:
    """Return a port of loopback that no program uses now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]
