"""JSON Schema of every message, for programs in other languages than Python."""

import inspect
from typing import Any

import msgspec

from ldo_service.schemas.message import Message
from ldo_service.schemas.topics import TOPICS


def message_types() -> tuple[type[Message], ...]:
    """Return the types of all messages and query answers, in the order of the topics."""
    both = [message for topic in TOPICS for message in (topic.message, topic.answer)]
    return tuple(message for message in both if message is not None)


def json_schema() -> dict[str, object]:
    """Return one document with the JSON Schemas of all messages.

    `$defs` maps the name of each message to its schema. `topics` maps each topic to the schema of
    its messages. `answers` maps each topic that takes requests by query to the schema of the reply.
    JSON Schema describes binary fields as base64 strings; in MessagePack, these fields have the
    type `bin`.
    """
    _, definitions = msgspec.json.schema_components(message_types())
    for definition in definitions.values():
        _clean_description(definition)
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


def _clean_description(definition: dict[str, Any]) -> None:
    """Remove the indentation of the source code from a description."""
    if "description" in definition:
        definition["description"] = inspect.cleandoc(definition["description"])
