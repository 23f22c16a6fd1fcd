"""Queries of programs outside the service, with replies in place of a network."""

from types import SimpleNamespace
from typing import Any

import pytest

from ldo_service.errors import ConfigError
from ldo_service.schemas import ControlAnswer, ControlRequest
from ldo_service.schemas.topics import CONTROL
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.message_reader import MessageReader


def test_malformed_answer_is_an_error_that_names_its_topic() -> None:
    payload = SimpleNamespace(to_bytes=lambda: b"\x80")  # A map without fields.
    replies = [SimpleNamespace(ok=None), SimpleNamespace(ok=SimpleNamespace(payload=payload))]
    session: Any = SimpleNamespace(get=lambda *_, **__: replies)
    reader = MessageReader(session, Endpoint())
    request = ControlRequest(stamp_ns=0, command="save")
    with pytest.raises(ConfigError, match="answered on control with a malformed ControlAnswer"):
        reader.request(CONTROL, request, ControlAnswer, 1.0)
