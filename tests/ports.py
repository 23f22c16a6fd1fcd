"""Ports of this machine that no other test process uses."""

import random
import socket

# Linux assigns ports from 32768 on to outgoing connections, so these can be in use at any time.
PORTS = range(20_000, 30_000)

_reservations: list[socket.socket] = []  # They last as long as the process.


def free_port() -> int:
    """Reserve a port of the loopback interface for the rest of this process.

    The port itself stays closed, so that the program under test can listen on it. A socket with an
    abstract name marks the port as taken for test processes that run in parallel.

    Returns:
        A number that this function returns once, to one process.
    """
    for port in random.SystemRandom().sample(PORTS, len(PORTS)):
        reservation = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            reservation.bind(f"\0ldo-test-port-{port}")
        except OSError:
            reservation.close()
            continue
        _reservations.append(reservation)
        if _is_closed(port):
            return port
    raise RuntimeError(f"all ports in {PORTS} are in use; end other test runs on this machine")


def free_endpoint() -> str:
    """Return an endpoint on a free port; see `free_port`."""
    return f"tcp/127.0.0.1:{free_port()}"


def _is_closed(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
