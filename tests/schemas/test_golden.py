"""Tests that messages of earlier versions decode, with and without our structs."""

from dataclasses import dataclass

import msgpack
import msgspec
import numpy as np
import pytest

from ldo_service.schemas import Array, Message, decode
from ldo_service.schemas.json_schema import message_types

from .examples import EXAMPLES, GOLDEN


@dataclass(frozen=True)
class Golden:
    """A golden file and the message that it must decode to."""

    body: bytes
    expected: Message


@pytest.fixture(params=EXAMPLES)
def golden(request: pytest.FixtureRequest) -> Golden:
    path = GOLDEN / f"{request.param}.msgpack"
    if not path.exists():
        pytest.fail(f"{path} is missing; run: python tests/schemas/examples.py")
    return Golden(path.read_bytes(), EXAMPLES[request.param])


def plain_values(value: object) -> object:
    """Return a message as a MessagePack library without our structs decodes it."""
    if isinstance(value, msgspec.Struct):
        fields = {name: plain_values(getattr(value, name)) for name in value.__struct_fields__}
        tag = type(value).__struct_config__.tag
        return {"type": tag, **fields} if tag else fields
    if isinstance(value, dict):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain_values(item) for item in value]
    return bytes(value) if isinstance(value, memoryview) else value


def assert_contains(expected_value: object, golden_value: object) -> None:
    """Assert equality, except for fields that an earlier version did not have."""
    if isinstance(expected_value, dict) and isinstance(golden_value, dict):
        for key, item in golden_value.items():
            assert_contains(expected_value[key], item)
    elif isinstance(expected_value, list) and isinstance(golden_value, list):
        assert len(expected_value) == len(golden_value)
        for expected_item, golden_item in zip(expected_value, golden_value, strict=True):
            assert_contains(expected_item, golden_item)
    else:
        assert expected_value == golden_value


def test_golden_file_decodes_to_the_expected_message(golden: Golden) -> None:
    assert decode(golden.body, type(golden.expected)) == golden.expected


def test_golden_file_has_the_same_values_in_a_plain_messagepack_library(golden: Golden) -> None:
    assert_contains(plain_values(golden.expected), msgpack.unpackb(golden.body))


def test_body_written_by_a_plain_messagepack_library_decodes(golden: Golden) -> None:
    body = msgpack.packb(plain_values(golden.expected))
    assert decode(body, type(golden.expected)) == golden.expected


def test_fields_of_a_later_version_are_ignored(golden: Golden) -> None:
    later = {**msgpack.unpackb(golden.body), "invented_tomorrow": [1, {"a": None}]}
    assert decode(msgpack.packb(later), type(golden.expected)) == golden.expected


def test_every_message_type_has_a_golden_file() -> None:
    assert {type(message) for message in EXAMPLES.values()} == set(message_types())
    assert {path.stem for path in GOLDEN.iterdir()} == set(EXAMPLES)


def test_array_on_the_wire_opens_as_documented_in_the_readme() -> None:
    frame = msgpack.unpackb((GOLDEN / "frame_rgbd.msgpack").read_bytes())
    depth = frame["depth_m"]
    opened = np.frombuffer(depth["data"], depth["dtype"]).reshape(depth["shape"])
    np.testing.assert_array_equal(opened, [[0, 1.5, 2], [0.25, 4, 0]])


def test_decoded_array_shares_the_body_and_is_read_only() -> None:
    body = (GOLDEN / "frame_rgbd.msgpack").read_bytes()
    depth = decode(body, type(EXAMPLES["frame_rgbd"])).depth_m.numpy()  # type: ignore[attr-defined]
    assert np.shares_memory(depth, np.frombuffer(body, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        depth[0, 0] = 1.0


def test_array_message_ignores_later_changes_of_its_source() -> None:
    values = np.zeros(3, np.float32)
    array = Array.of(values)
    values[:] = 7
    np.testing.assert_array_equal(array.numpy(), [0, 0, 0])
