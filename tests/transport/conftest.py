"""Fixtures for a router on a free local port and its clients."""

from collections.abc import Callable, Iterator

import pytest
import zenoh

from ldo_service.transport.zenoh_transport import Endpoint, open_session
from tests.ports import free_port


@pytest.fixture
def network() -> Iterator[Endpoint]:
    """Yield the endpoint of a router that runs as long as the test."""
    network = Endpoint("test", f"tcp/127.0.0.1:{free_port()}")
    with open_session(network, router=True):
        yield network


@pytest.fixture
def client(network: Endpoint) -> Iterator[Callable[[], zenoh.Session]]:
    """Yield a function that opens sessions as other processes would."""
    sessions: list[zenoh.Session] = []

    def open_client() -> zenoh.Session:
        sessions.append(open_session(network))
        return sessions[-1]

    yield open_client
    for session in sessions:
        session.close()
