"""Tests of the JSON Schema for programs in other languages."""

import json

from ldo_service.schemas.json_schema import json_schema
from ldo_service.schemas.topics import TOPICS


def test_schema_is_valid_json_and_lists_every_topic_with_its_message() -> None:
    schema = json.loads(json.dumps(json_schema()))
    topic_names = {topic.name for topic in TOPICS}
    assert set(schema["topics"]) == topic_names
    for reference in schema["topics"].values():
        name = reference["$ref"].removeprefix("#/$defs/")
        assert "stamp_ns" in schema["$defs"][name]["properties"]


def test_every_reference_in_the_schema_resolves() -> None:
    schema = json_schema()
    text = json.dumps(schema)
    names = {part.split('"')[0] for part in text.split('"#/$defs/')[1:]}
    assert names <= set(schema["$defs"])  # type: ignore[call-overload]


def test_descriptions_have_no_indentation_of_the_source() -> None:
    definitions = json_schema()["$defs"]
    assert isinstance(definitions, dict)
    descriptions = [one["description"] for one in definitions.values() if "description" in one]
    assert any("\n" in text for text in descriptions)
    assert not [text for text in descriptions if "\n    " in text]


def test_each_message_type_belongs_to_one_topic() -> None:
    types = [topic.message for topic in TOPICS]
    assert len(set(types)) == len(types)


def test_topic_names_are_unique_and_fit_a_key_expression() -> None:
    names = [topic.name for topic in TOPICS]
    assert len(set(names)) == len(names)
    for topic in TOPICS:
        assert topic.expression("robot-1") == f"ldo/robot-1/{topic.name}"
        assert not set(topic.name) & set("*$?# ")
