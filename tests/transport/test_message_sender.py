import pytest

from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.message_sender import MessageSender


def test_epoch_of_a_sender_does_not_depend_on_the_wall_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("time.time_ns", lambda: 0)  # A robot without a clock starts in 1970.
    session, network = object(), Endpoint("robot", "tcp/127.0.0.1:7447")
    epochs = {MessageSender(session, network)._epoch for _ in range(3)}  # type: ignore[arg-type]
    assert len(epochs) == 3
    assert min(epochs) > 0
