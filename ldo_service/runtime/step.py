"""Step of an actor: decoding of the input, checks and encoding of the outputs.

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
    """Output of a step with its encoded body."""

    topic: Topic
    message: Message
    body: bytes


def produce(actor: Actor, messages: Iterable[Message]) -> list[Produced]:
    """Check and encode the outputs of a step.

    Args:
        actor: The actor; its `situation` has the credit of each nonblocking output.
        messages: The outputs that the actor's handler yields.

    Raises:
        TypeError: The type of a message belongs to none of the actor's outputs.
        RuntimeError: The actor produced more messages on a nonblocking output than its credit
            allows.
    """
    topics = {out.topic.message: out.topic for out in actor.outputs}
    credits = dict(actor.situation.credits)
    produced: list[Produced] = []
    for message in messages:
        topic = topics.get(type(message))
        if topic is None:
            raise TypeError(
                f"{actor.name} produced a {type(message).__name__}, which is not in its outputs. "
                "Yield only messages of the actor's `outputs`."
            )
        if topic in credits:
            credits[topic] -= 1
            if credits[topic] < 0:
                raise RuntimeError(
                    f"{actor.name} produced a message of {topic.name} without credit. Its handler "
                    "must check has_credit before it yields such a message."
                )
        produced.append(Produced(topic, message, encode(message)))
    return produced


class MessageDecoder:
    """Decoder of an actor's inputs.

    If several consecutive messages of a topic are malformed, the decoder logs only the first one.
    """

    def __init__(self, actor: str) -> None:
        self._actor = actor
        self._rejecting: set[Topic] = set()  # Topics whose last message was malformed.

    def message_of(self, delivery: Delivery) -> Message | None:
        """Return the decoded message of a delivery, or None if the message is malformed."""
        topic, header = delivery.port.topic, delivery.header
        try:
            message = decode(delivery.body, topic.message)
        except msgspec.DecodeError as error:
            if topic not in self._rejecting:
                log.warning(
                    "%s: message of %s (#%d from %s) rejected: %s. Further malformed messages of "
                    "this topic are only counted.",
                    self._actor, topic.name, header.seq, header.source, error,
                )  # fmt: skip
            self._rejecting.add(topic)
            return None
        self._rejecting.discard(topic)
        return message
