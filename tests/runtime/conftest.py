"""Fixtures shared with the tests of the transport."""

from tests.transport.conftest import client, network

__all__ = ["client", "network"]
