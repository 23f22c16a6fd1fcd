"""What other programs import: publish camera frames, follow poses and the map.

    from ldo_service.client import connect

    with connect("robot") as service:
        for pose in service.poses():
            print(pose.status, pose.T_odom_camera.translation)

Imports no numerics. A subscriber never slows the robot: it gets the newest messages, and what it
does not take in time is dropped on its side.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import msgspec
import numpy as np
import zenoh

from ldo_service.errors import ConfigError
from ldo_service.runtime.links import Header, encode
from ldo_service.runtime.zenoh_transport import DEFAULT_ENDPOINT, Network, open_session
from ldo_service.schemas import CameraModel, CameraRgbd, Image, Message, TrackedPose, decode
from ldo_service.schemas.topics import CAMERA_RGBD, POSE_TRACKED, Topic

M = TypeVar("M", bound=Message)


class Client:
    """A connection to one robot's topics; made by `connect`."""

    def __init__(self, session: zenoh.Session, network: Network) -> None:
        self._session, self._network = session, network
        self._sent = 0
        self._epoch = time.time_ns()
        self._camera = session.declare_publisher(
            network.expression(CAMERA_RGBD.name), congestion_control=zenoh.CongestionControl.DROP
        )

    def publish(
        self,
        color: np.ndarray,
        depth: np.ndarray,
        camera: CameraModel,
        depth_scale: float,
        stamp_ns: int | None = None,
    ) -> None:
        """Send one exposure.

        color        [H, W, 3] uint8 RGB
        depth        [H, W] uint16 or float32, registered to colour; 0 or NaN: not measured
        depth_scale  units of `depth` per metre
        stamp_ns     of the exposure; default: now
        Raises ValueError for arrays that do not fit the camera.
        """
        message = CameraRgbd(
            stamp_ns=time.time_ns() if stamp_ns is None else stamp_ns,
            frame=self._sent,
            camera=camera,
            color=Image.raw("rgb8", color),
            depth=Image.raw("z16" if depth.dtype == np.uint16 else "f32", depth),
            depth_scale=depth_scale,
        )
        self.send(message)

    def send(self, frame: CameraRgbd) -> None:
        """Send a frame, which may be compressed. May block for some milliseconds, and is dropped
        when the network is congested."""
        header = Header("camera", self._epoch, self._sent, frame.stamp_ns)
        self._camera.put(msgspec.msgpack.encode(frame), attachment=encode(header))
        self._sent += 1

    def poses(self, keep: int = 1) -> Iterator[TrackedPose]:
        """Every tracked pose as it comes, for ever; of those not taken in time the newest stay."""
        for _, message in self.messages(POSE_TRACKED, keep):
            assert isinstance(message, TrackedPose)
            yield message

    def messages(self, topic: Topic, keep: int = 1) -> Iterator[tuple[Header, Message]]:
        """Header and message of each sample on a topic, for ever."""
        with self._subscriber(topic.name, keep) as subscriber:
            for sample in subscriber:
                yield _header(sample), _message(sample, _type_of(topic))

    @contextmanager
    def listen(self, name: str, of: type[M], keep: int = 256) -> Iterator[Callable[[], list[M]]]:
        """A function that returns what has come since it was last called; never waits.

        `name` may hold `*`, such as `health/*`.
        """
        with self._subscriber(name, keep) as subscriber:

            def inbox() -> list[M]:
                samples = iter(subscriber.try_recv, None)
                return [_message(sample, of) for sample in samples]

            yield inbox

    def last(self, topic: Topic, timeout_s: float = 3.0) -> list[Message]:
        """The last value of a state topic, all its parts; empty when there is none yet."""
        replies = self._session.get(
            self._network.expression(topic.name),
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,  # or one part of several would be kept
        )
        return [_message(r.ok, _type_of(topic)) for r in replies if r.ok is not None]

    def _subscriber(self, name: str, keep: int) -> Any:
        ring = zenoh.handlers.RingChannel(keep)
        return self._session.declare_subscriber(self._network.expression(name), ring)


def _type_of(topic: Topic) -> type[Message]:
    if topic.message is None:
        raise ConfigError(f"{topic.name} is declared and has no messages in this version.")
    return topic.message


def _header(sample: Any) -> Header:
    return decode(sample.attachment.to_bytes(), Header)


def _message(sample: Any, of: type[M]) -> M:
    return decode(sample.payload.to_bytes(), of)


@contextmanager
def connect(robot: str = "robot", endpoint: str = DEFAULT_ENDPOINT) -> Iterator[Client]:
    """Connect to a running service. Raises ConfigError when nobody answers."""
    network = Network(robot, endpoint)
    with open_session(network) as session:
        yield Client(session, network)
