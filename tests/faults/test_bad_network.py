"""Tests of the bad network between two namespaces."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Thread

import pytest

from .bad_network import (
    ADDRESSES,
    HOST,
    ROBOT,
    BadNetwork,
    NamespacesUnavailable,
    delete_namespaces_of_ended_programs,
    enter_namespace,
    two_namespaces,
)

PORT = 7450
DELAY_S = 0.1

# Program that prints its namespaces and a process in one of them, and then waits.
WAITING = """
import subprocess, time
from tests.faults.bad_network import HOST, ROBOT, command_in, two_namespaces
with two_namespaces(seed=1):
    process = subprocess.Popen(command_in(HOST, "sleep", "60"))
    time.sleep(0.3)
    print(ROBOT, HOST, process.pid, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def network() -> Iterator[BadNetwork]:
    try:
        with two_namespaces(seed=1) as network:
            yield network
    except NamespacesUnavailable as error:
        pytest.skip(str(error))


def socket_in(namespace: str, kind: socket.SocketKind) -> socket.socket:
    """Return a socket of a namespace."""
    made: list[socket.socket] = []

    def make() -> None:
        enter_namespace(namespace)
        made.append(socket.socket(socket.AF_INET, kind))

    thread = Thread(target=make)
    thread.start()
    thread.join()
    made[0].settimeout(2.0)
    return made[0]


def is_running(pid: str) -> bool:
    """Return whether a process runs; one that has ended but was not waited for does not."""
    try:
        return Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_packets_are_delayed_and_cut_in_one_direction(network: BadNetwork) -> None:
    network.out.delay_s, network.back.is_cut = DELAY_S, True
    with socket_in(ROBOT, socket.SOCK_DGRAM) as robot, socket_in(HOST, socket.SOCK_DGRAM) as host:
        robot.bind((ADDRESSES[ROBOT], PORT))
        host.bind((ADDRESSES[HOST], PORT))
        started_s = time.monotonic()
        robot.sendto(b"out", (ADDRESSES[HOST], PORT))
        assert host.recv(9) == b"out"
        assert time.monotonic() - started_s >= DELAY_S
        host.sendto(b"lost", (ADDRESSES[ROBOT], PORT))
        robot.settimeout(0.3)
        with pytest.raises(TimeoutError):
            robot.recv(9)
        network.heal()
        host.sendto(b"back", (ADDRESSES[ROBOT], PORT))
        assert robot.recv(9) == b"back"


def test_forged_packet_resets_a_connection(network: BadNetwork) -> None:
    with ExitStack() as stack:
        server = stack.enter_context(socket_in(ROBOT, socket.SOCK_STREAM))
        client = stack.enter_context(socket_in(HOST, socket.SOCK_STREAM))
        server.bind((ADDRESSES[ROBOT], PORT))
        server.listen()
        client.connect((ADDRESSES[ROBOT], PORT))
        accepted = stack.enter_context(server.accept()[0])
        accepted.settimeout(2.0)
        client.send(b"one")
        assert accepted.recv(9) == b"one"
        network.reset_connections()
        client.send(b"two")
        with pytest.raises(ConnectionResetError):
            client.recv(9)


@pytest.mark.parametrize("name", ["TERM", "KILL"])
def test_ended_program_leaves_no_process_and_no_namespace(network: BadNetwork, name: str) -> None:
    assert network.is_alive()  # The fixture skips the test if there can be no namespaces.
    with subprocess.Popen([sys.executable, "-c", WAITING], stdout=-1, text=True) as program:
        assert program.stdout
        *namespaces, sleeping = program.stdout.readline().split()
        program.send_signal(getattr(signal, f"SIG{name}"))
    until_s = time.monotonic() + 5.0
    while is_running(sleeping) and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not is_running(sleeping)
    if name == "KILL":
        delete_namespaces_of_ended_programs()
    assert [path for path in namespaces if Path("/run/netns", path).exists()] == []
    assert Path("/run/netns", ROBOT).exists()
