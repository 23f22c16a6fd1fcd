"""Fixtures of the transport's tests that the runtime's tests share."""

from tests.transport.conftest import client, network

__all__ = ["client", "network"]
