"""Sender of messages from a program outside the service."""

import time
from typing import Any

import msgspec
import zenoh

from ldo_service.schemas import Message
from ldo_service.schemas.topics import FROM_ODOMETRY, FROM_OPERATORS, FROM_OUTSIDE

from .endpoint import Endpoint
from .flow_control import Header, encode_link, new_epoch


class MessageSender:
    """Publishers of one program outside the service, such as a camera program.

    A publisher is declared at the first use of its message type. A congested network drops
    messages.
    """

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        self._session, self._network = session, network
        self._epoch = new_epoch()
        self._publishers: dict[type[Message], Any] = {}  # Publisher by message type.

    def send(self, message: Message, source: str, number: int) -> None:
        """Publish a message on the topic of its type. The call may block for a few milliseconds.

        Args:
            message: The message.
            source: Name of the producer in the header.
            number: Offset of the message in the sequence of the producer's messages on this topic.
        """
        header = Header(source, self._epoch, number, message.stamp_ns)
        body = msgspec.msgpack.encode(message)
        self._publisher(type(message)).put(body, attachment=encode_link(header))

    def has_subscriber(self, kind: type[Message]) -> bool:
        """Return whether the topic of a message type has a subscriber."""
        return self._publisher(kind).matching_status.matching

    def wait_for_subscriber(self, kind: type[Message], timeout_s: float) -> bool:
        """Wait for a subscriber of the topic of a message type.

        Returns:
            False if there is no subscriber within `timeout_s`.
        """
        until_s = time.monotonic() + timeout_s
        while not self.has_subscriber(kind) and time.monotonic() < until_s:
            time.sleep(0.02)
        return self.has_subscriber(kind)

    def _publisher(self, kind: type[Message]) -> Any:
        if kind not in self._publishers:
            known = (*FROM_OUTSIDE, *FROM_ODOMETRY, *FROM_OPERATORS)
            (topic,) = (topic for topic in known if topic.message is kind)
            self._publishers[kind] = self._session.declare_publisher(
                self._network.expression(topic.name),
                congestion_control=zenoh.CongestionControl.DROP,
            )
        return self._publishers[kind]
