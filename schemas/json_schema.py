"""JSON Schema of every message, for programs in other languages than Python."""

import msgspec

from ldo_service.schemas.message import Message
from ldo_service.schemas.topics import TOPICS


def message_types() -> tuple[type[Message], ...]:
    """Return the types of all messages and query answers, in the order of the topics."""
    both = [message for topic in TOPICS for message in (topic.message, topic.answer)]
    return tuple(message for message in both if message is not None)


def json_schema() -> dict[str, object]:
    """Return one document with the schemas of all messages.

    `$defs` has each message by name, `topics` the message of each topic, and `answers` the reply to
    a query on a topic that takes requests. Binary fields are base64 strings in terms of JSON
    Schema; on the wire they are MessagePack's `bin`.
    """
    _, definitions = msgspec.json.schema_components(message_types())
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "LDO-SLAM messages",
        "$defs": definitions,
        "topics": {topic.name: {"$ref": f"#/$defs/{topic.message.__name__}"} for topic in TOPICS},
        "answers": {
            topic.name: {"$ref": f"#/$defs/{topic.answer.__name__}"}
            for topic in TOPICS
            if topic.answer is not None
        },
    }
