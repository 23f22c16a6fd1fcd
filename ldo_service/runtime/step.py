"""One step of an actor: its messages decoded, its outputs encoded and checked.

The service and the replay share this code.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec

from ldo_service.schemas import Message, decode, encode
from ldo_service.schemas.topics import Topic

from .actor import Actor
from .inlet import Delivery

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Produced:
    topic: Topic
    message: Message
    body: bytes


def produce(actor: Actor, messages: Iterable[Message]) -> list[Produced]:
    """Raises when a message is none of the outputs, or has no room where none may wait."""
    topics = {out.topic.message: out.topic for out in actor.outputs}
    room = dict(actor.situation.credits)
    produced: list[Produced] = []
    for message in messages:
        topic = topics.get(type(message))
        if topic is None:
            raise TypeError(f"{type(message).__name__} is none of {actor.name}'s outputs")
        if topic in room:
            room[topic] -= 1
            if room[topic] < 0:
                raise RuntimeError(f"{actor.name} made {topic.name} without room for it")
        produced.append(Produced(topic, message, encode(message)))
    return produced


class MessageDecoder:
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
