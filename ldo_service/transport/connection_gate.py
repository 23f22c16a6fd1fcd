"""Gate in front of the TLS port of the router, run as a separate process.

Zenoh accepts any number of TCP connections to a TLS port. Each connection takes a file descriptor
of the service until its TLS handshake times out. After each failed handshake, Zenoh accepts no
connection for 0.1 s. The gate therefore listens on the port that other machines see, and passes all
bytes on to a loopback port of the router. The gate does not decrypt the bytes: programs and router
check each other's certificates as they do without a gate.

A connection is *unproven* until the router has accepted the certificate of its client. The gate
limits unproven connections as follows:

- The gate passes nothing on before the first bytes of a TLS handshake have arrived.
- The gate closes a connection that is unproven for longer than `HANDSHAKE_S`.
- If more than `MAX_UNPROVEN` connections are unproven, the gate closes one of them. It chooses the
  address with the most unproven connections, and there prefers one that has sent nothing.
- At most `MAX_HANDSHAKES` connections of one address are in a handshake with the router at the same
  time. For all addresses together, the limit is `MAX_ALL_HANDSHAKES`.

This file runs as a script: `python -I connection_gate.py DESCRIPTOR HOST PORT MAX_CONNECTIONS`.
DESCRIPTOR is the listening socket; HOST and PORT are the address of the router. The script imports
the standard library only, so that the process starts at once and takes little memory. Each line on
its standard input is a new port of the router. The process ends when its standard input ends. At
most once in `REPORT_S`, it prints the number of connections that it closed because of the limits.
"""

import asyncio
import os
import resource
import signal
import socket
import sys
from collections import Counter

# Time from the start of a connection to the router's answer to the client's certificate,
# seconds: that of Zenoh. At a delay of 0.5 s, a handshake without losses takes 2 s.
HANDSHAKE_S = 10.0
MAX_UNPROVEN = 64  # Unproven connections; a robot has fewer than ten programs.
MAX_HANDSHAKES = 4  # Handshakes of one address at a time.
MAX_ALL_HANDSHAKES = 16  # Handshakes of all addresses at a time.
LEAVE_WITHIN_S = 2.0  # Time to send the last bytes when a proven connection closes, seconds.
REPORT_S = 30.0  # Time between two reports, seconds.
HANDSHAKE_RECORD = b"\x16\x03"  # A TLS record of a handshake begins with these bytes.
# Maximum size of what a program sends before the router answers, bytes; a ClientHello has at most
# 2 kB.
MAX_HELLO_BYTES = 16_384
# Random number of a ServerHello that asks for another ClientHello (RFC 8446, section 4.1.3).
HELLO_RETRY = bytes.fromhex("cf21ad74e59a6111be1d8c021e65b891c2a211167abb8c5e079e09e2c8a8339c")
# Largest TLS alert with its record, bytes. The router sends an alert if it rejects a certificate.
MAX_ALERT_BYTES = 64


class Connection:
    """Connection of a client program, and the connection to the router that carries its bytes.

    Attributes:
        address: IP address of the client.
        has_spoken: The first bytes of a handshake have arrived.
        is_proven: The router has accepted the certificate of the client.
    """

    def __init__(self, gate: "Gate", client: asyncio.Transport) -> None:
        self._gate, self.client = gate, client
        self.router: asyncio.Transport | None = None
        self.address = str((client.get_extra_info("peername") or ("",))[0])
        self.has_spoken = self.is_proven = self.is_closed = False
        self.hello = b""
        self._has_router_spoken = self._has_client_answered = False
        self._answer_bytes = 0
        self._deadline = gate.loop.call_later(HANDSHAKE_S, gate.refuse, self)

    def from_client(self, data: bytes) -> None:
        """Pass bytes from the client on to the router.

        The first bytes wait until the gate connects to the router; see `Gate.wait_for_turn`.
        """
        if self.router is not None:
            self._has_client_answered = self._has_router_spoken
            self.router.write(data)
            return
        self.hello += data
        is_tls = HANDSHAKE_RECORD.startswith(self.hello[: len(HANDSHAKE_RECORD)])
        if not is_tls or len(self.hello) > MAX_HELLO_BYTES:
            self.close()
        elif not self.has_spoken and len(self.hello) >= len(HANDSHAKE_RECORD):
            self.has_spoken = True
            self._gate.wait_for_turn(self)

    def from_router(self, data: bytes) -> None:
        """Pass bytes from the router to the client.

        The answer of the router shows whether it has accepted the certificate of the client.
        """
        if not self._has_router_spoken:
            self._has_router_spoken = HELLO_RETRY not in data[:64]
        elif self._has_client_answered and not self.is_proven:
            self._answer_bytes += len(data)
            if self._answer_bytes > MAX_ALERT_BYTES:
                self.is_proven = True
                self._deadline.cancel()
                self._gate.end_handshake(self)
        self.client.write(data)

    def start(self, router: asyncio.Transport) -> None:
        """Begin to pass bytes on to the router."""
        self.router = router
        if self.is_closed:
            self._leave_router()
        else:
            router.write(self.hello)

    def close(self) -> None:
        """Close the connection of the client and the one to the router."""
        if self.is_closed:
            return
        self.is_closed = True
        self._deadline.cancel()
        if self.is_proven:
            self.client.close()  # Bytes that wait are sent first.
            self._gate.loop.call_later(LEAVE_WITHIN_S, self.client.abort)
        else:
            self.client.abort()
        if self.router is not None:
            self._leave_router()
        self._gate.forget(self)

    def _leave_router(self) -> None:
        """Ask the router to close its connection; an unproven one counts as a handshake until then.

        The router takes 0.1 s for each failed handshake, so its connections would add up if the
        gate began further handshakes at once.
        """
        assert self.router is not None
        within_s = LEAVE_WITHIN_S if self.is_proven else HANDSHAKE_S
        self._gate.loop.call_later(within_s, self.router.abort)
        self.router.resume_reading()
        if self.router.can_write_eof() and not self.router.is_closing():
            self.router.write_eof()


class Side(asyncio.Protocol):
    """Protocol of asyncio for a connection of the gate, from a client or to the router.

    The protocol slows the sender to the receiver's speed.
    """

    def __init__(self, gate: "Gate", connection: Connection | None = None) -> None:
        self._gate, self._connection = gate, connection
        self._is_client = connection is None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._connection is None:
            self._connection = Connection(self._gate, transport)
            self._gate.admit(self._connection)

    def data_received(self, data: bytes) -> None:
        assert self._connection is not None
        if not self._connection.is_closed:
            take = self._connection.from_client if self._is_client else self._connection.from_router
            take(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        if self._connection is not None:
            self._connection.close()
            if not self._is_client:
                self._gate.end_handshake(self._connection)

    def pause_writing(self) -> None:
        if (sender := self._sender()) is not None:
            sender.pause_reading()

    def resume_writing(self) -> None:
        if (sender := self._sender()) is not None and not sender.is_closing():
            sender.resume_reading()

    def _sender(self) -> asyncio.Transport | None:
        """Return the connection whose bytes are written to this one; None before it exists."""
        assert self._connection is not None
        return self._connection.router if self._is_client else self._connection.client


class Gate:
    """Gate between clients on the network and the TLS port of the router; see the module.

    A connection is unproven until the router has accepted the certificate of its client. The gate
    limits the number of unproven connections.
    """

    def __init__(self, host: str, port: int, max_connections: int) -> None:
        """Initialize inside a running event loop.

        Args:
            host: Address of the router.
            port: Port of the router.
            max_connections: Maximum number of connections, proven ones included.
        """
        self.loop = asyncio.get_running_loop()
        self._router = host, port
        self._max_connections = max_connections
        self._open: dict[Connection, None] = {}  # Open connections, oldest first.
        self._waiting: dict[
            Connection, None
        ] = {}  # Connections that wait for a turn, oldest first.
        self._connecting: set[asyncio.Task[None]] = set()
        self._handshakes: dict[Connection, None] = {}
        self._refused = 0  # Number of connections closed because of a limit since the last report.

    def admit(self, new: Connection) -> None:
        """Add a connection; if there are too many, close an unproven one.

        A connection is unproven until the router has accepted the certificate of its client.
        """
        self._open[new] = None
        unproven = [one for one in self._open if not one.is_proven]
        if len(unproven) > MAX_UNPROVEN or len(self._open) > self._max_connections:
            addresses = Counter(one.address for one in unproven)
            most = max(addresses.values())
            crowd = [one for one in unproven if addresses[one.address] == most]
            # The oldest one that has sent nothing, or else the oldest one.
            self.refuse(min(crowd, key=lambda one: one.has_spoken))

    def refuse(self, connection: Connection) -> None:
        """Close an unproven connection because of a limit, and count it for the next report."""
        connection.close()
        self._refused += 1
        if self._refused == 1:
            self.loop.call_later(REPORT_S, self._report)

    def _report(self) -> None:
        print(self._refused, flush=True)
        self._refused = 0

    def redirect(self, port: int) -> None:
        """Close all connections, and pass new ones on to another port of the router."""
        self._router = self._router[0], port
        for connection in list(self._open):
            connection.close()

    def wait_for_turn(self, connection: Connection) -> None:
        """Queue a connection until the number of running handshakes permits another one.

        The gate then connects to the router for this client. At most `MAX_HANDSHAKES` handshakes
        run for one client address, and at most `MAX_ALL_HANDSHAKES` for all addresses.
        """
        self._waiting[connection] = None
        self._start_waiting()

    def end_handshake(self, connection: Connection) -> None:
        """Count the handshake of a connection as ended, and let the next one start."""
        self._handshakes.pop(connection, None)
        self._start_waiting()

    def forget(self, connection: Connection) -> None:
        """Remove a closed connection from the lists of the gate."""
        self._open.pop(connection, None)
        self._waiting.pop(connection, None)

    def _start_waiting(self) -> None:
        busy = Counter(one.address for one in self._handshakes)
        for connection in list(self._waiting):
            if len(self._handshakes) >= MAX_ALL_HANDSHAKES:
                return
            if busy[connection.address] < MAX_HANDSHAKES:
                busy[connection.address] += 1
                del self._waiting[connection]
                self._handshakes[connection] = None
                task = self.loop.create_task(self._connect(connection))
                self._connecting.add(task)
                task.add_done_callback(self._connecting.discard)

    async def _connect(self, connection: Connection) -> None:
        try:
            router, _ = await self.loop.create_connection(
                lambda: Side(self, connection), *self._router
            )
        except OSError:
            connection.close()
            self.end_handshake(connection)
        else:
            connection.start(router)


async def _run(listener: socket.socket, host: str, port: int, max_connections: int) -> None:
    loop = asyncio.get_running_loop()
    gate = Gate(host, port, max_connections)
    parent_ended = asyncio.Event()

    def take_port() -> None:
        if ports := os.read(sys.stdin.fileno(), 4096):
            gate.redirect(int(ports.split()[-1]))
        else:
            parent_ended.set()

    loop.add_reader(sys.stdin.fileno(), take_port)
    async with await loop.create_server(lambda: Side(gate), sock=listener):
        await parent_ended.wait()
    os._exit(0)  # The router is gone, so connections need not be closed in order.


def main(arguments: list[str]) -> None:
    """Run the gate until the standard input ends."""
    descriptor, host, port, max_connections = arguments
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # The service ends the gate after itself.
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    listener = socket.socket(fileno=int(descriptor))
    asyncio.run(_run(listener, host, int(port), int(max_connections)))


if __name__ == "__main__":
    main(sys.argv[1:])
