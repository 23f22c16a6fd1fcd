"""Python client of the service: publishes camera frames, receives poses and the map.

    from ldo_service.client import connect

    with connect("robot") as service:
        for pose in service.poses():
            print(pose.status, pose.T_odom_camera.translation)

The module imports no numerical code of the service. The client buffers the newest messages and
drops older ones, so a slow program does not slow the robot.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import zenoh

from ldo_service.errors import ConfigError, did_you_mean
from ldo_service.schemas import (
    AddLabel,
    CameraColor,
    CameraDepth,
    CameraModel,
    CameraRgbd,
    ControlAnswer,
    ControlRequest,
    Image,
    LabelNames,
    MapObjects,
    Message,
    OdometryPrior,
    Pose,
    RefineMap,
    TrackedPose,
)
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import (
    BY_NAME,
    CONTROL,
    LABEL_ADD,
    LABEL_NAMES,
    MAP_OBJECTS,
    MAP_REFINE,
    POSE_TRACKED,
    TOPICS,
    Topic,
)
from ldo_service.transport.flow_control import Header
from ldo_service.transport.keys import OF_CLIENT, TlsKeys
from ldo_service.transport.message_reader import MessageReader
from ldo_service.transport.message_sender import MessageSender
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT, Endpoint, open_session

M = TypeVar("M", bound=Message)


class Client:
    """Connection to the topics of one robot, created by `connect`."""

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        self._network = network
        self._sender = MessageSender(session, network)
        self._reader = MessageReader(session, network)
        self._sent = self._sent_requests = self._priors = 0
        self._numbers: Counter[type[Message]] = Counter()  # Messages sent, by type.

    def publish(
        self,
        color: np.ndarray,
        depth: np.ndarray,
        camera: CameraModel,
        depth_scale: float,
        stamp_ns: int | None = None,
    ) -> None:
        """Send one RGB-D frame.

        Args:
            color: RGB image, [H, W, 3], uint8.
            depth: Depth registered to the color image, [H, W], uint16 or float32; 0 or NaN where
                unknown.
            camera: Intrinsics of the color camera.
            depth_scale: Units of `depth` per meter.
            stamp_ns: Time of the exposure, ns; the current time by default.

        Raises:
            ValueError: The arrays do not fit the camera.
        """
        message = CameraRgbd(
            stamp_ns=_stamp(stamp_ns),
            frame=self._sent,
            camera=camera,
            color=Image.raw("rgb8", color),
            depth=Image.raw_depth(depth),
            depth_scale=depth_scale,
        )
        self.send(message)

    def publish_color(
        self, color: np.ndarray, camera: CameraModel, stamp_ns: int | None = None
    ) -> None:
        """Send a color image, whose depth image is sent separately by `publish_depth`.

        The arguments are those of `publish`.
        """
        image = Image.raw("rgb8", color)
        self.send(
            CameraColor(stamp_ns=_stamp(stamp_ns), frame=self._sent, camera=camera, image=image)
        )

    def publish_depth(
        self,
        depth: np.ndarray,
        camera: CameraModel,
        depth_scale: float,
        T_color_depth: Pose = IDENTITY,
        stamp_ns: int | None = None,
    ) -> None:
        """Send a depth image of a separate depth camera.

        The service pairs the depth image with the color image of the nearest stamp.

        Args:
            depth: Depth image, [H, W], uint16 or float32; 0 or NaN where unknown.
            camera: Intrinsics of the depth camera.
            depth_scale: Units of `depth` per meter.
            T_color_depth: Transform from the depth camera to the color camera, meters.
            stamp_ns: Time of the exposure, ns; the current time by default.
        """
        message = CameraDepth(
            stamp_ns=_stamp(stamp_ns),
            frame=self._sent,
            camera=camera,
            image=Image.raw_depth(depth),
            depth_scale=depth_scale,
            T_color_depth=T_color_depth,
        )
        self.send(message)

    def publish_prior(self, T_prior_base: Pose, stamp_ns: int | None = None) -> None:
        """Send an odometry prior: a pose from another odometry of the robot.

        Args:
            T_prior_base: Pose of the robot's base in the frame of that odometry, meters.
            stamp_ns: Time of the measurement, ns; the current time by default. It must come from
                the same clock as the stamps of the camera frames.
        """
        message = OdometryPrior(stamp_ns=_stamp(stamp_ns), T_prior_base=T_prior_base)
        self._sender.send(message, "odometry", self._priors)
        self._priors += 1

    def send(self, frame: CameraRgbd | CameraColor | CameraDepth) -> None:
        """Send an RGB-D frame, color image or depth image, which may be compressed.

        The call may block for a few milliseconds. A congested network drops the message.
        """
        kind = type(frame)
        self._sender.send(frame, "camera", self._numbers[kind])
        self._sent += 1
        self._numbers[kind] += 1

    @property
    def has_subscriber(self) -> bool:
        """True if a subscriber of camera/rgbd exists."""
        return self._sender.has_subscriber(CameraRgbd)

    def wait_for_subscriber(self, timeout_s: float = 3.0) -> bool:
        """Wait for a subscriber of camera/rgbd.

        A new connection learns of subscribers after a short delay.

        Returns:
            False if no subscriber was found within `timeout_s`.
        """
        return self._sender.wait_for_subscriber(CameraRgbd, timeout_s)

    def poses(self, keep: int = 1) -> Iterator[TrackedPose]:
        """Yield tracked poses as they arrive; the iteration never ends.

        Args:
            keep: Number of buffered poses; older ones are dropped.
        """
        for _, message in self.messages(POSE_TRACKED, keep):
            assert isinstance(message, TrackedPose)
            yield message

    def messages(self, topic: Topic | str, keep: int = 1) -> Iterator[tuple[Header, Message]]:
        """Yield header and message of each sample on a topic; the iteration never ends.

        Messages that a restarted producer repeats are skipped.

        Args:
            topic: The topic or its name.
            keep: Number of buffered messages; older ones are dropped.

        Raises:
            ConfigError: No topic has this name.
        """
        yield from self._reader.messages(_topic(topic), keep)

    @contextmanager
    def poller(self, name: str, of: type[M], keep: int = 256) -> Iterator[Callable[[], list[M]]]:
        """Yield a function that returns the messages since its last call, without waiting.

        Args:
            name: Key of the messages; it may contain `*`, as in `health/*`.
            of: Type of the messages; malformed ones are logged and skipped.
            keep: Number of buffered messages; older ones are dropped.
        """
        with self._reader.poller(name, of, keep) as inbox:
            yield inbox

    def latest(self, topic: Topic | str, timeout_s: float = 3.0) -> list[Message]:
        """Request the last value of a state topic, which is a topic that keeps its last value.

        Args:
            topic: The topic or its name.
            timeout_s: Maximum time to wait, seconds.

        Returns:
            The messages of the value, several for a map snapshot; empty if there is no value yet.

        Raises:
            ConfigError: No topic has this name, or the topic keeps no last value.
        """
        topic = _topic(topic)
        if not topic.is_state:
            keeping = ", ".join(other.name for other in TOPICS if other.is_state)
            raise ConfigError(
                f"{topic.name} keeps no last value. Choose a topic with a last value: {keeping}."
            )
        return self._reader.last_values(topic, timeout_s)

    def objects(self, timeout_s: float = 3.0) -> MapObjects:
        """Request the current objects of the map.

        Raises:
            ConfigError: The service does not reply, or it has no objects, for example because no
                detector runs.
        """
        for message in self.latest(MAP_OBJECTS, timeout_s):
            assert isinstance(message, MapObjects)
            return message
        if "mapper" in self.live_actors():
            raise ConfigError(
                "the map has no objects yet. Objects appear with the first keyframe that a "
                "detector has processed. If no detector runs, start the service with `ldo serve "
                "--set detector.model=NAME`; `ldo models list` lists the names. A service with "
                "--localize publishes no objects; they are in the folder of its map."
            )
        raise self._no_service("replies", MAP_OBJECTS)

    def live_actors(self, timeout_s: float = 1.0) -> set[str]:
        """Return the names of the actors with a running process."""
        return self._reader.live_actors(timeout_s)

    def control(self, verb: str, timeout_s: float = 120.0) -> ControlAnswer:
        """Request the service to pause, resume, save or reset, and wait for all actors.

        Args:
            verb: The command: pause, resume, save or reset.
            timeout_s: Maximum time to wait, seconds.

        Returns:
            The reply. `ok` is False if an actor failed or the command is unknown; `message` has the
            reason.

        Raises:
            ConfigError: The service does not reply.
        """
        request = ControlRequest(stamp_ns=time.time_ns(), command=verb)
        answer = self._reader.request(CONTROL, request, ControlAnswer, timeout_s)
        if answer is None:
            raise self._no_service("replies", CONTROL)
        return answer

    def refine(
        self,
        iterations: int,
        first_rate: float = 1.0,
        last_rate: float = 1.0,
        timeout_s: float = 3.0,
    ) -> None:
        """Request further optimization of the Gaussians with the existing keyframes.

        The call does not wait for the optimization, whose changes are published on `map/delta`.

        Args:
            iterations: Number of iterations, at most 500.
            first_rate: Factor of the step size in the first iteration, in (0, 1].
            last_rate: Factor of the step size in the last iteration, in (0, 1].
            timeout_s: Maximum time to wait for the connection to the mapper, seconds.

        Raises:
            ValueError: An argument is out of range.
            ConfigError: No mapper subscribes to the request.
        """
        message = RefineMap(
            stamp_ns=time.time_ns(),
            iterations=iterations,
            initial_rate=first_rate,
            final_rate=last_rate,
        )
        message.check()
        self._send_request(MAP_REFINE, message, timeout_s)

    def add_label(self, name: str, timeout_s: float = 60.0) -> tuple[str, ...]:
        """Add a name to the vocabulary of the labeller.

        The call waits for the labeller, which may be busy with a region for a few seconds.

        Args:
            name: The new name.
            timeout_s: Maximum time to wait, seconds.

        Returns:
            All names of the vocabulary.

        Raises:
            ConfigError: The name is invalid, or the labeller rejects it or does not reply.
        """
        try:
            message = AddLabel(stamp_ns=time.time_ns(), name=name)
        except ValueError as error:
            raise ConfigError(
                f"the label {name[:40]!r} cannot be added: {error}. Choose another name."
            ) from None
        until_s = time.monotonic() + timeout_s
        with self.poller(LABEL_NAMES.name, LabelNames) as inbox:
            self._send_request(LABEL_ADD, message, min(timeout_s, 3.0))
            while time.monotonic() < until_s:
                for answer in inbox():
                    if answer.stamp_ns == message.stamp_ns:
                        return _names_or_why(name, answer)
                time.sleep(0.02)
        raise self._no_service("replies", LABEL_ADD)

    def _send_request(self, topic: Topic, message: RefineMap | AddLabel, timeout_s: float) -> None:
        """Publish a request as soon as its topic has a subscriber.

        Raises:
            ConfigError: No actor subscribes to the request within `timeout_s` seconds.
        """
        if not self._sender.wait_for_subscriber(type(message), timeout_s):
            raise self._no_service("listens", topic)
        self._sender.send(message, "operator", self._sent_requests)
        self._sent_requests += 1

    def _no_service(self, does: str, topic: Topic) -> ConfigError:
        return ConfigError(
            f"no service {does} on {self._network.expression(topic.name)}. Check the name of the "
            "robot and whether its service is running: `ldo doctor`."
        )


def _topic(topic: Topic | str) -> Topic:
    if isinstance(topic, Topic):
        return topic
    if topic not in BY_NAME:
        hint = did_you_mean(topic, BY_NAME, "`ldo topics` lists all topics.")
        raise ConfigError(f"there is no topic {topic!r}. {hint}")
    return BY_NAME[topic]


def _names_or_why(name: str, answer: LabelNames) -> tuple[str, ...]:
    if answer.error:
        raise ConfigError(f"the label {name!r} was not added: {answer.error}")
    return answer.names


def _stamp(stamp_ns: int | None) -> int:
    return time.time_ns() if stamp_ns is None else stamp_ns


@contextmanager
def connect(
    robot: str = "robot", endpoint: str = DEFAULT_ENDPOINT, keys: str | Path | None = None
) -> Iterator[Client]:
    """Connect to a running service.

    Args:
        robot: Name of the robot.
        endpoint: Address of the router of the service.
        keys: Folder with TLS keys, created by `ldo keys`; needed for a `tls/` endpoint.

    Raises:
        ConfigError: No service replies, or the keys are rejected.
    """
    network = Endpoint(robot, endpoint, TlsKeys.of(keys))
    if network.keys:
        network.keys.warn_of_expiry(OF_CLIENT)
    with open_session(network) as session:
        yield Client(session, network)
