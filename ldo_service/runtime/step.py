"""What one step of an actor makes, encoded and checked: the same live and in a replay."""

from collections.abc import Iterable
from dataclasses import dataclass

from ldo_service.schemas import Message, encode
from ldo_service.schemas.topics import Topic

from .actor import Actor


@dataclass(frozen=True, slots=True)
class Produced:
    topic: Topic
    message: Message
    body: bytes


def produce(actor: Actor, messages: Iterable[Message]) -> list[Produced]:
    """Raises when a message is none of the outputs, or has no room where none may wait."""
    topics = {out.topic.message: out.topic for out in actor.outputs}
    room = dict(actor.situation.room)
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
