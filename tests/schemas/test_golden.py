"""What an earlier version has sent, every later one reads: with our structs and without them."""

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
    body: bytes
    expected: Message


@pytest.fixture(params=EXAMPLES)
def golden(request: pytest.FixtureRequest) -> Golden:
    path = GOLDEN / f"{request.param}.msgpack"
    if not path.exists():
        pytest.fail(f"{path} is missing: python tests/schemas/examples.py writes it")
    return Golden(path.read_bytes(), EXAMPLES[request.param])


def plain(value: object) -> object:
    """What a MessagePack library without our structs sees."""
    if isinstance(value, msgspec.Struct):
        fields = {name: plain(getattr(value, name)) for name in value.__struct_fields__}
        tag = type(value).__struct_config__.tag
        return {"type": tag, **fields} if tag else fields
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    return bytes(value) if isinstance(value, memoryview) else value


def assert_holds(whole: object, part: object) -> None:
    """Equal, but for fields that an earlier version did not have."""
    if isinstance(whole, dict) and isinstance(part, dict):
        for key, item in part.items():
            assert_holds(whole[key], item)
    elif isinstance(whole, list) and isinstance(part, list):
        assert len(whole) == len(part)
        for one, other in zip(whole, part, strict=True):
            assert_holds(one, other)
    else:
        assert whole == part


def test_golden_file_decodes_to_the_expected_message(golden: Golden) -> None:
    assert decode(golden.body, type(golden.expected)) == golden.expected


def test_golden_file_reads_the_same_with_a_plain_messagepack_library(golden: Golden) -> None:
    assert_holds(plain(golden.expected), msgpack.unpackb(golden.body))


def test_what_a_plain_messagepack_library_writes_decodes(golden: Golden) -> None:
    body = msgpack.packb(plain(golden.expected))
    assert decode(body, type(golden.expected)) == golden.expected


def test_fields_of_a_later_version_are_ignored(golden: Golden) -> None:
    later = {**msgpack.unpackb(golden.body), "invented_tomorrow": [1, {"a": None}]}
    assert decode(msgpack.packb(later), type(golden.expected)) == golden.expected


def test_every_message_type_has_a_golden_file() -> None:
    assert {type(message) for message in EXAMPLES.values()} == set(message_types())
    assert {path.stem for path in GOLDEN.iterdir()} == set(EXAMPLES)


def test_an_array_on_the_wire_opens_as_the_readme_says() -> None:
    frame = msgpack.unpackb((GOLDEN / "frame_rgbd.msgpack").read_bytes())
    depth = frame["depth_m"]
    opened = np.frombuffer(depth["data"], depth["dtype"]).reshape(depth["shape"])
    np.testing.assert_array_equal(opened, [[0, 1.5, 2], [0.25, 4, 0]])


def test_an_array_opens_without_a_copy_and_cannot_be_written() -> None:
    body = (GOLDEN / "frame_rgbd.msgpack").read_bytes()
    depth = decode(body, type(EXAMPLES["frame_rgbd"])).depth_m.numpy()  # type: ignore[attr-defined]
    assert np.shares_memory(depth, np.frombuffer(body, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        depth[0, 0] = 1.0


def test_a_message_does_not_follow_later_changes_to_the_array_it_was_made_of() -> None:
    values = np.zeros(3, np.float32)
    array = Array.of(values)
    values[:] = 7
    np.testing.assert_array_equal(array.numpy(), [0, 0, 0])
