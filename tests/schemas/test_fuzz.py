"""Fuzz tests: every body decodes to a valid message or raises a DecodeError."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ldo_service.schemas import Array, FrameRgbd, Message, Pose, TrackedPose, decode, encode
from ldo_service.schemas.array import DTYPES
from ldo_service.schemas.pose import MAX_COORDINATE_M

from .examples import CAMERA, EXAMPLES

examples = st.sampled_from(list(EXAMPLES.values()))


def assert_valid_or_rejected(body: bytes, message: type[Message]) -> None:
    """Assert that a body raises a DecodeError or gives a message that survives a round trip."""
    try:
        decoded = decode(body, message)
    except msgspec.DecodeError:
        return
    assert decode(encode(decoded), message) == decoded or has_nan(decoded)


def has_nan(message: Message) -> bool:
    return "nan" in repr(message)  # A message with NaN differs from itself.


@given(examples, st.data())
def test_truncated_body_raises_a_decode_error(message: Message, data: st.DataObject) -> None:
    body = encode(message)
    length = data.draw(st.integers(0, len(body) - 1))
    with pytest.raises(msgspec.DecodeError):
        decode(body[:length], type(message))


@settings(max_examples=500)
@given(examples, st.lists(st.tuples(st.integers(0), st.integers(0, 255)), min_size=1, max_size=4))
def test_flipped_bytes_give_a_valid_message_or_a_decode_error(
    message: Message, flips: list[tuple[int, int]]
) -> None:
    body = bytearray(encode(message))
    for position, value in flips:
        body[position % len(body)] = value
    assert_valid_or_rejected(bytes(body), type(message))


@given(st.binary(max_size=200), examples)
def test_random_bytes_raise_a_decode_error(noise: bytes, message: Message) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode(noise, type(message))


def test_deeply_nested_body_raises_a_decode_error() -> None:
    body = b"\x81\xa1y" + b"\x91" * 100_000
    with pytest.raises(msgspec.DecodeError, match="cannot be decoded"):
        decode(body, FrameRgbd)


def test_message_of_another_type_raises_a_decode_error() -> None:
    for message in EXAMPLES.values():
        for other in EXAMPLES.values():
            if type(other) is not type(message):
                with pytest.raises(msgspec.DecodeError):
                    decode(encode(message), type(other))


@given(st.sampled_from(DTYPES), st.data())
def test_any_array_survives_the_round_trip(dtype: str, data: st.DataObject) -> None:
    shape = array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    values = data.draw(arrays(np.dtype("<" + dtype), shape))
    array = msgspec.msgpack.decode(msgspec.msgpack.encode(Array.of(values)), type=Array)
    np.testing.assert_array_equal(array.numpy(), values)
    assert array.numpy().dtype == values.dtype


@given(
    st.tuples(*[st.floats(-MAX_COORDINATE_M, MAX_COORDINATE_M)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.integers(0, 2**63 - 1),
)
def test_any_pose_survives_the_round_trip(
    translation: tuple[float, float, float], quaternion: tuple[float, ...], stamp_ns: int
) -> None:
    unit = np.array(quaternion) / np.linalg.norm(quaternion)
    pose = Pose(translation, tuple(unit.tolist()))
    message = msgspec.structs.replace(
        EXAMPLES["tracked_pose"], stamp_ns=stamp_ns, T_odom_camera=pose
    )
    assert decode(encode(message), TrackedPose) == message


@given(arrays(np.float32, (2, 3), elements=st.floats(0, 100, width=32)))
def test_any_depth_image_survives_the_round_trip(depth_m: np.ndarray) -> None:
    frame = msgspec.structs.replace(EXAMPLES["frame_rgbd"], depth_m=Array.of(depth_m))
    received = decode(encode(frame), FrameRgbd)
    np.testing.assert_array_equal(received.depth_m.numpy(), depth_m)
    assert received.camera == CAMERA
