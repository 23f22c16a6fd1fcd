"""Messages of what arrived, or a word on why not."""

import logging

import msgspec

from ldo_service.schemas import Message, decode
from ldo_service.schemas.topics import Topic

from .inlet import Delivery

log = logging.getLogger(__name__)


class Reader:
    """Says once an episode that messages of a topic cannot be decoded."""

    def __init__(self, actor: str) -> None:
        self._actor = actor
        self._rejecting: set[Topic] = set()  # topics whose last message could not be decoded

    def message_of(self, delivery: Delivery) -> Message | None:
        """None for one that cannot be decoded."""
        topic, header = delivery.port.topic, delivery.header
        try:
            message = decode(delivery.body, topic.message)
        except msgspec.DecodeError as error:
            if topic not in self._rejecting:
                log.warning(
                    "%s: %s #%d from %s rejected: %s. Those that follow are counted.",
                    self._actor, topic.name, header.seq, header.source, error,
                )  # fmt: skip
            self._rejecting.add(topic)
            return None
        self._rejecting.discard(topic)
        return message
