"""Tests of the gate in front of a TLS port, with a small TLS server in place of the router."""

import asyncio
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from ldo_service.errors import ConfigError
from ldo_service.transport import connection_gate
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import LOOPBACK, Endpoint
from ldo_service.transport.gate_process import GateProcess, guarded
from ldo_service.transport.keys import CA, CERTIFICATE, KEY, TlsKeys
from tests.ports import free_port

PATIENCE_S = 60.0
GREETING = bytes(range(200))  # Longer than an alert: the router's answer to a certificate.


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gate") / "keys"
    authority = CertificateAuthority.new(folder, days=2)
    authority.add("service", "service", "robot", days=1)
    authority.add("viewer", "viewer", "robot", days=1)
    return folder


class EchoRouter:
    """TLS server that requires certificates, greets each client, and returns what it receives."""

    def __init__(self, keys: Path) -> None:
        folder = keys / "service"
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        self._context.load_verify_locations(folder / CA)
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._listener = socket.create_server((LOOPBACK, 0))
        self.port = self._listener.getsockname()[1]
        self.accepted = 0
        self.open = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                plain, _ = self._listener.accept()
                self.accepted += 1
                threading.Thread(target=self._serve, args=(plain,), daemon=True).start()

    def _serve(self, plain: socket.socket) -> None:
        self.open += 1
        with (
            suppress(OSError),
            plain,
            self._context.wrap_socket(plain, server_side=True) as secured,
        ):
            secured.sendall(GREETING)
            while data := secured.recv(1 << 16):
                secured.sendall(data)
        self.open -= 1

    def close(self) -> None:
        self._listener.close()


@pytest.fixture
def router(keys: Path) -> Iterator[EchoRouter]:
    router = EchoRouter(keys)
    yield router
    router.close()


@pytest.fixture
def gate(router: EchoRouter) -> Iterator[int]:
    """Yield the port of a gate in front of the router."""
    with socket.create_server((LOOPBACK, 0)) as listener:
        process = GateProcess(listener, router.port)
        yield listener.getsockname()[1]
        process.close()


@contextmanager
def tls_client(port: int, keys: Path) -> Iterator[ssl.SSLSocket]:
    context = TlsKeys(keys / "viewer").context()
    with (
        socket.create_connection((LOOPBACK, port), PATIENCE_S) as plain,
        context.wrap_socket(plain, server_hostname=LOOPBACK) as secured,
    ):
        assert received(secured, len(GREETING)) == GREETING
        yield secured


def received(connection: socket.socket, size: int) -> bytes:
    parts: list[bytes] = []
    while size > 0:
        part = connection.recv(min(size, 1 << 16))
        assert part, "the connection was closed"
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def eventually(is_true: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < until_s, "the condition was not met in time"
        time.sleep(0.01)


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(1 << 16):
            pass
        return True
    except BlockingIOError:
        return False
    except OSError:
        return True


def idle(port: int, count: int, stack: ExitStack, first: bytes = b"") -> list[socket.socket]:
    made = []
    for _ in range(count):
        made.append(stack.enter_context(socket.create_connection((LOOPBACK, port), PATIENCE_S)))
        with suppress(OSError):
            made[-1].sendall(first)
    return made


def client_hello() -> bytes:
    """Return the first bytes of a client without keys."""
    outgoing = ssl.MemoryBIO()
    context = ssl.create_default_context()
    hello = context.wrap_bio(ssl.MemoryBIO(), outgoing, server_hostname="localhost")
    with suppress(ssl.SSLWantReadError):
        hello.do_handshake()
    return outgoing.read()


def test_bytes_of_a_program_with_keys_pass_unchanged(
    gate: int, router: EchoRouter, keys: Path
) -> None:
    body = bytes(range(256)) * 100
    with tls_client(gate, keys) as client:
        for _ in range(50):
            client.sendall(body)
            assert received(client, len(body)) == body
    eventually(lambda: router.open == 0)


def test_more_bytes_than_fit_into_buffers_pass_in_both_directions_at_once() -> None:
    body = connection_gate.HANDSHAKE_RECORD + bytes(range(256)) * 40_000
    with ExitStack() as stack:
        echo, listener = (socket.create_server((LOOPBACK, 0)) for _ in range(2))
        stack.callback(echo.close)
        stack.callback(listener.close)
        process = GateProcess(listener, echo.getsockname()[1])
        stack.callback(process.close)
        client = stack.enter_context(socket.create_connection(listener.getsockname(), PATIENCE_S))
        client.sendall(body[:2])
        server, _ = echo.accept()
        server.sendall(received(server, 2))
        sending = threading.Thread(target=client.sendall, args=(body[2:],))
        sending.start()

        def reply() -> None:
            while data := server.recv(1 << 16):
                server.sendall(data)
            server.close()

        replying = threading.Thread(target=reply)
        replying.start()
        assert received(client, len(body)) == body
        sending.join()
        client.close()
        replying.join()


def test_idle_connections_never_reach_the_router_and_keep_no_program_out(
    gate: int, router: EchoRouter, keys: Path
) -> None:
    with ExitStack() as stack:
        silent = idle(gate, 300, stack)
        with tls_client(gate, keys) as client:
            assert router.accepted == 1
            eventually(
                lambda: sum(is_closed(one) for one in silent) >= 300 - connection_gate.MAX_UNPROVEN
            )
            more = idle(gate, 300, stack)
            eventually(
                lambda: sum(is_closed(one) for one in more) >= 300 - connection_gate.MAX_UNPROVEN
            )
            client.sendall(b"still here")
            assert received(client, 10) == b"still here"
        assert router.accepted == 1


async def test_programs_that_never_show_a_certificate_take_few_connections_to_the_router(
    router: EchoRouter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_gate, "HANDSHAKE_S", 2.0)
    gate = connection_gate.Gate(LOOPBACK, router.port, max_connections=256)
    server = await gate.loop.create_server(lambda: connection_gate.Side(gate), LOOPBACK, 0)
    port = server.sockets[0].getsockname()[1]
    with ExitStack() as stack:
        stalled = await asyncio.to_thread(idle, port, 100, stack, client_hello())
        most = 0

        def all_closed() -> bool:
            nonlocal most
            most = max(most, router.open)
            return all(is_closed(one) for one in stalled)

        await asyncio.to_thread(eventually, all_closed)
        assert 0 < most <= connection_gate.MAX_HANDSHAKES
    await asyncio.to_thread(eventually, lambda: router.open == 0)
    server.close()


async def test_handshakes_that_the_router_has_not_given_up_count_after_the_program_has_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connection_gate, "HANDSHAKE_S", 1000.0)
    held: list[asyncio.StreamWriter] = []
    slow = await asyncio.start_server(lambda _reader, writer: held.append(writer), LOOPBACK, 0)
    gate = connection_gate.Gate(LOOPBACK, slow.sockets[0].getsockname()[1], max_connections=256)
    server = await gate.loop.create_server(lambda: connection_gate.Side(gate), LOOPBACK, 0)
    port = server.sockets[0].getsockname()[1]
    for _ in range(3):
        with ExitStack() as stack:
            await asyncio.to_thread(idle, port, 30, stack, client_hello())
        async with asyncio.timeout(PATIENCE_S):
            while gate._open:
                await asyncio.sleep(0.01)
    assert len(held) == connection_gate.MAX_HANDSHAKES
    for writer in held:
        writer.close()
        await writer.wait_closed()
    async with asyncio.timeout(PATIENCE_S):
        while gate._handshakes:
            await asyncio.sleep(0.01)
    server.close()
    slow.close()


def test_other_protocols_are_closed_at_once(gate: int, router: EchoRouter) -> None:
    with ExitStack() as stack:
        [http] = idle(gate, 1, stack, first=b"GET / HTTP/1.0\r\n\r\n")
        http.settimeout(PATIENCE_S)
        with suppress(ConnectionResetError):
            assert http.recv(1) == b""
    assert router.accepted == 0


@pytest.mark.parametrize("failures", [0, 2])
def test_gate_that_was_killed_is_started_again(
    router: EchoRouter, keys: Path, monkeypatch: pytest.MonkeyPatch, failures: int
) -> None:
    start, failed = GateProcess._start, list[GateProcess]()

    def start_later(process: GateProcess) -> subprocess.Popen[str]:
        if len(failed) < failures:
            failed.append(process)
            raise OSError(12, "Cannot allocate memory")
        return start(process)

    with socket.create_server((LOOPBACK, 0)) as listener:
        process, port = GateProcess(listener, router.port), listener.getsockname()[1]
        monkeypatch.setattr(GateProcess, "_start", start_later)
        with tls_client(port, keys) as client:
            killed = process.pid
            process._process.kill()
            with suppress(ConnectionResetError):
                assert client.recv(1) == b""
        with tls_client(port, keys):
            assert process.pid != killed
        process.close()


def test_gate_that_was_redirected_while_it_ended_is_started_again(
    router: EchoRouter, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that has closed its input stands for one that is about to end."""
    close_input = "import os, time; os.close(0); print(1, flush=True); time.sleep(600)"
    start, ending = GateProcess._start, list[subprocess.Popen[str]]()

    def start_ending(_: GateProcess) -> subprocess.Popen[str]:
        monkeypatch.setattr(GateProcess, "_start", start)
        command = sys.executable, "-c", close_input
        pipe = subprocess.PIPE
        ending.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
        assert ending[0].stdout is not None
        ending[0].stdout.readline()
        return ending[0]

    monkeypatch.setattr(GateProcess, "_start", start_ending)
    with socket.create_server((LOOPBACK, 0)) as listener:
        process, port = GateProcess(listener, 1), listener.getsockname()[1]
        process.redirect(router.port)
        ending[0].kill()
        with tls_client(port, keys):
            assert router.accepted == 1
        process.close()


def test_gate_that_was_redirected_while_it_was_started_leads_to_the_other_router(
    router: EchoRouter, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, is_started, may_return = GateProcess._start, threading.Event(), threading.Event()

    def start_slowly(process: GateProcess) -> subprocess.Popen[str]:
        started = start(process)
        is_started.set()
        assert may_return.wait(PATIENCE_S)
        return started

    other = EchoRouter(keys)
    with socket.create_server((LOOPBACK, 0)) as listener:
        process, port = GateProcess(listener, router.port), listener.getsockname()[1]
        monkeypatch.setattr(GateProcess, "_start", start_slowly)
        process._process.kill()
        assert is_started.wait(PATIENCE_S)
        redirecting = threading.Thread(target=process.redirect, args=(other.port,))
        redirecting.start()
        redirecting.join(0.2)  # It should wait for the start.
        may_return.set()
        redirecting.join()

        def reaches_other_router() -> bool:
            with suppress(OSError, AssertionError), tls_client(port, keys):
                pass  # The redirection may close a connection that was accepted before it.
            return other.accepted > 0

        eventually(reaches_other_router)
        process.close()
    other.close()


def test_redirected_gate_closes_its_connections_and_leads_to_the_other_router(
    router: EchoRouter, keys: Path
) -> None:
    other = EchoRouter(keys)
    with socket.create_server((LOOPBACK, 0)) as listener:
        process, port = GateProcess(listener, router.port), listener.getsockname()[1]
        with tls_client(port, keys) as client:
            process.redirect(other.port)
            with suppress(OSError):
                assert client.recv(1) == b""
        with tls_client(port, keys):
            assert (router.accepted, other.accepted) == (1, 1)
        process.close()
    other.close()


def test_occupied_port_is_an_error_that_names_the_endpoint(keys: Path) -> None:
    port = free_port()
    with socket.create_server((LOOPBACK, port)):
        network = Endpoint("robot", f"tls/{LOOPBACK}:{port}", TlsKeys(keys / "service"))
        expected = pytest.raises(ConfigError, match=f"cannot listen on tls/{LOOPBACK}:{port}")
        with expected, guarded(network):
            pass
