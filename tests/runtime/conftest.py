"""Fixtures of the transport's tests that the runtime's tests share."""

from tests.transport.conftest import network

__all__ = ["network"]
