"""Fuzz targets for bytes that arrive over the network."""

from functools import partial
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig
from ldo_service.cameras.ros2 import RosCamera, RosTopics
from ldo_service.detection.labellers.chat_completion import read_answer
from ldo_service.geometry import codecs
from ldo_service.geometry.codecs import encode_jpeg
from ldo_service.schemas import CameraColor, CameraDepth, CameraRgbd, decode
from ldo_service.transport.flow_control import (
    ConsumerHello,
    Credit,
    Header,
    ProducerHello,
    decode_request,
    encode_link,
)
from tests.cameras import ros
from tests.cameras.ros import camera_info, cdr, compressed, image
from tests.schemas.examples import EXAMPLES

from .target import Target, chosen, numbered

KINDS = tuple(type(message) for message in EXAMPLES.values())
BODIES = [msgspec.msgpack.encode(message) for message in EXAMPLES.values()]
CAMERAS = (CameraRgbd, CameraColor, CameraDepth)
GRAY = np.arange(35, dtype=np.uint8).reshape(5, 7) * 7
COLOR = np.stack([GRAY, GRAY + 1, GRAY + 2], axis=2)
DEPTH = GRAY.astype(np.uint16) * 20
INFO = cdr(camera_info())
PNG_DEPTH = compressed("16UC1; png", bytes(12) + cv2.imencode(".png", ros.DEPTH_MM)[1].tobytes())


def messages(body: bytes, _folder: Path) -> None:
    """Decode a message; a valid one must encode and decode again."""
    if body:
        kind = KINDS[body[0] % len(KINDS)]
        decode(msgspec.msgpack.encode(decode(body[1:], kind)), kind)


def frames(body: bytes, _folder: Path) -> None:
    """Handle a frame in the frame source, which must reject unusable frames without failing."""
    source = FrameSource(FrameSourceConfig(min_side_px=1))
    for kind in CAMERAS:
        try:
            message = decode(body, kind)
        except msgspec.DecodeError:
            continue
        list(source.handle(message))


def images(body: bytes, _folder: Path) -> None:
    """Decode an image; the first three bytes are its size and encoding."""
    if len(body) < 3:
        return
    width, height, which, data = *body[:3], memoryview(body[3:])
    decoders = [partial(codecs.decode_color, name) for name in ("rgb8", "bgr8", "jpeg", "png")]
    decoders += [
        partial(codecs.decode_depth, name) for name in ("png", "z16", "z16+zstd", "f32+zstd")
    ]
    decoders[which % len(decoders)](width, height, data)


def camera_seeds() -> list[bytes]:
    examples = [EXAMPLES[name] for name in ("camera_rgbd", "camera_color", "camera_depth")]
    return [msgspec.msgpack.encode(example) for example in examples]


def image_seeds() -> list[bytes]:
    def encoded(suffix: str, pixels: np.ndarray) -> bytes:
        return cv2.imencode(suffix, pixels)[1].tobytes()

    bodies = (
        COLOR.tobytes(),
        COLOR.tobytes(),
        encoded(".jpg", COLOR),
        encoded(".png", COLOR),
        encoded(".png", DEPTH),
        DEPTH.tobytes(),
        codecs.encode_depth(DEPTH)[1],
        codecs.encode_depth(DEPTH.astype(np.float32))[1],
    )
    return [bytes([7, 5, number]) + body for number, body in enumerate(bodies)]


PLAIN = RosTopics("/c/image_raw", "/d/image_raw")
COMPRESSED = RosTopics("/c/image_raw/compressed", "/d/image_raw/compressedDepth")
ROS = [  # Topics, the topic of the fuzzed bytes, and valid bytes for all topics.
    (topics, topic, {topics.camera_info: INFO, topics.color: color, topics.depth: depth})
    for topics, color, depth in (
        (PLAIN, cdr(image("rgb8", ros.COLOR)), cdr(image("16UC1", ros.DEPTH_MM))),
        (COMPRESSED, cdr(compressed("jpeg", encode_jpeg(ros.COLOR))), cdr(PNG_DEPTH)),
    )
    for topic in (topics.camera_info, topics.color, topics.depth)
]


def ros_sample(body: bytes, _folder: Path) -> None:
    """Handle a sample in the ROS 2 camera; the first byte selects its topic."""
    topics, changed, good = ROS[body[0] % len(ROS) if body else 0]
    camera = RosCamera(topics, lambda _: None)
    for topic, sample in good.items():
        list(camera.take(topic, body[1:] if topic == changed else sample))


ANSWER = (
    b'{"choices": [{"message": {"content": "A sofa."}, "logprobs": {"content": '
    b'[{"token": "sofa", "logprob": -0.25}]}}]}'
)
LINKS = (
    decode_request,
    partial(decode, kind=Header),
    partial(decode, kind=ProducerHello),
)
LINK_BODIES = [
    encode_link(Credit("mapper", 1, 3, 4, 12)),
    encode_link(Header("camera", 1, 2, 3)),
    encode_link(ProducerHello(1, {"mapper": 3})),
]

TARGETS = [
    Target("messages", messages, numbered(BODIES), (msgspec.DecodeError,)),
    Target("camera frames", frames, camera_seeds(), ()),
    Target("images", images, image_seeds()),
    Target(
        "links",
        chosen(*LINKS),
        [*numbered(LINK_BODIES), b"\0" + encode_link(ConsumerHello("mapper"))],
        (msgspec.DecodeError,),
    ),
    Target("ROS 2", ros_sample, numbered(good[topic] for _, topic, good in ROS), ()),
    Target("answers of a server", lambda body, _: read_answer(body), [ANSWER]),
]
