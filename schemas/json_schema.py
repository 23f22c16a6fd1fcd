"""JSON Schema of every message, for programs that are not written in Python."""

import msgspec

from ldo_service.schemas.message import Message
from ldo_service.schemas.topics import TOPICS


def message_types() -> tuple[type[Message], ...]:
    both = [message for topic in TOPICS for message in (topic.message, topic.answer)]
    return tuple(message for message in both if message is not None)


def json_schema() -> dict[str, object]:
    """One document: `$defs` has each message by name, `topics` says which travels where, `answers`
    what a query on a topic that is asked is answered with.

    Binary fields, base64 strings in JSON Schema's terms, are MessagePack's `bin` on the wire.
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
