"""What other programs import: publish camera frames, follow poses and the map.

    from ldo_service.client import connect

    with connect("robot") as service:
        for pose in service.poses():
            print(pose.status, pose.T_odom_camera.translation)

Imports no numerics. A subscriber never slows the robot: it gets the newest messages, and what it
does not take in time is dropped on its side.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
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
    decode,
)
from ldo_service.schemas.pose import IDENTITY
from ldo_service.schemas.topics import (
    BY_NAME,
    CONTROL,
    FROM_ODOMETRY,
    FROM_OPERATORS,
    FROM_OUTSIDE,
    LABEL_ADD,
    LABEL_NAMES,
    MAP_OBJECTS,
    MAP_REFINE,
    POSE_TRACKED,
    TOPICS,
    Topic,
)
from ldo_service.transport.flow_control import ALIVE, Header, SequenceTracker, encode_link
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import DEFAULT_ENDPOINT, Endpoint, open_session

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)


class Client:
    """A connection to one robot's topics; made by `connect`."""

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        self._session, self._network = session, network
        self._sent = self._asked = self._priors = 0
        self._numbers: Counter[type[Message]] = Counter()  # of frames and halves sent
        self._epoch = time.time_ns()
        self._publishers: dict[type[Message], Any] = {}  # by message

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
            stamp_ns=_stamp(stamp_ns),
            frame=self._sent,
            camera=camera,
            color=Image.raw("rgb8", color),
            depth=_raw_depth(depth),
            depth_scale=depth_scale,
        )
        self.send(message)

    def publish_color(
        self, color: np.ndarray, camera: CameraModel, stamp_ns: int | None = None
    ) -> None:
        """Send colour alone; `publish_depth` sends the other half. Arguments as in `publish`."""
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
        """Send depth alone, of a camera of its own. It is paired with the colour of nearest stamp.

        T_color_depth  from coordinates of the depth camera to the colour camera's
        Other arguments as in `publish`.
        """
        message = CameraDepth(
            stamp_ns=_stamp(stamp_ns),
            frame=self._sent,
            camera=camera,
            image=_raw_depth(depth),
            depth_scale=depth_scale,
            T_color_depth=T_color_depth,
        )
        self.send(message)

    def publish_prior(self, T_prior_base: Pose, stamp_ns: int | None = None) -> None:
        """Send where another odometry of the robot has its base, in a frame of its own.

        stamp_ns  of the measurement, by the clock that stamps frames; default: now
        """
        message = OdometryPrior(stamp_ns=_stamp(stamp_ns), T_prior_base=T_prior_base)
        header = Header("odometry", self._epoch, self._priors, message.stamp_ns)
        body = msgspec.msgpack.encode(message)
        self._publisher(OdometryPrior).put(body, attachment=encode_link(header))
        self._priors += 1

    def send(self, frame: CameraRgbd | CameraColor | CameraDepth) -> None:
        """Send a frame or half of one, which may be compressed. May block for some milliseconds,
        and is dropped when the network is congested."""
        kind = type(frame)
        header = Header("camera", self._epoch, self._numbers[kind], frame.stamp_ns)
        self._publisher(kind).put(msgspec.msgpack.encode(frame), attachment=encode_link(header))
        self._sent += 1
        self._numbers[kind] += 1

    def _publisher(self, kind: type[Message]) -> Any:
        if kind not in self._publishers:
            known = (*FROM_OUTSIDE, *FROM_ODOMETRY, *FROM_OPERATORS)
            (topic,) = (topic for topic in known if topic.message is kind)
            self._publishers[kind] = self._session.declare_publisher(
                self._network.expression(topic.name),
                congestion_control=zenoh.CongestionControl.DROP,
            )
        return self._publishers[kind]

    @property
    def has_subscriber(self) -> bool:
        """Whether anybody subscribes to this client's camera/rgbd."""
        return self._publisher(CameraRgbd).matching_status.matching

    def wait_for_subscriber(self, timeout_s: float = 3.0) -> bool:
        """Who has just connected hears of subscribers a moment later. False: of none in time."""
        until_s = time.monotonic() + timeout_s
        while not self.has_subscriber and time.monotonic() < until_s:
            time.sleep(0.02)
        return self.has_subscriber

    def poses(self, keep: int = 1) -> Iterator[TrackedPose]:
        """Every tracked pose as it comes, for ever; of those not taken in time the newest stay."""
        for _, message in self.messages(POSE_TRACKED, keep):
            assert isinstance(message, TrackedPose)
            yield message

    def messages(self, topic: Topic | str, keep: int = 1) -> Iterator[tuple[Header, Message]]:
        """Header and message of each sample on a topic, or one of that name, for ever; what a
        producer repeats that was started again is left out. Of those not taken in time the newest
        `keep` stay. Raises ConfigError for a name that no topic has."""
        topic, numbers = _topic(topic), SequenceTracker()
        with self._subscriber(topic.subscription_key, keep) as subscriber:
            for sample in subscriber:
                header = _header(sample)
                if numbers.observe(header):
                    yield header, _message(sample, topic.message)

    @contextmanager
    def poller(self, name: str, of: type[M], keep: int = 256) -> Iterator[Callable[[], list[M]]]:
        """A function that returns what has come since it was last called; never waits.

        `name` may hold `*`, such as `health/*`.
        """
        with self._subscriber(name, keep) as subscriber:

            def inbox() -> list[M]:
                return list(_readable(iter(subscriber.try_recv, None), of))

            yield inbox

    def latest(self, topic: Topic | str, timeout_s: float = 3.0) -> list[Message]:
        """The last value of a state topic, or the one of that name, all its parts; empty when there
        is none yet. Raises ConfigError for a topic that keeps none, and for a name that none has.
        """
        topic = _topic(topic)
        if not topic.is_state:
            keeping = ", ".join(other.name for other in TOPICS if other.is_state)
            raise ConfigError(f"{topic.name} keeps no last value. Those that do: {keeping}.")
        replies = self._session.get(
            self._network.expression(topic.name),
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,  # or one part of several would be kept
        )
        return list(_readable((r.ok for r in replies if r.ok is not None), topic.message))

    def objects(self, timeout_s: float = 3.0) -> MapObjects:
        """The objects of the map as of now. Raises ConfigError when nobody answers: a map without
        a detector has none."""
        for message in self.latest(MAP_OBJECTS, timeout_s):
            assert isinstance(message, MapObjects)
            return message
        if "mapper" in self.live_actors():
            raise ConfigError(
                "the map has no objects yet, which takes a keyframe, also after a restart, and a "
                "detector that looked at it: `ldo serve --set detector.model=...`; `ldo models` "
                "tells how. A service that localises takes none: those of its map are in the map's "
                "folder."
            )
        raise self._nobody("answers", MAP_OBJECTS)

    def live_actors(self, timeout_s: float = 1.0) -> set[str]:
        """Names of the actors whose process is there."""
        expression = self._network.expression(f"{ALIVE}/*")
        replies = self._session.liveliness().get(expression, timeout=timeout_s)
        return {str(r.ok.key_expr).rsplit("/", 1)[1] for r in replies if r.ok is not None}

    def control(self, verb: str, timeout_s: float = 120.0) -> ControlAnswer:
        """Ask the service to pause, resume, save or reset; returns when all actors have done it.

        `ok` of the answer is false when one has not, or when there is no such verb; `text` says.
        Raises ConfigError when nobody answers.
        """
        replies = self._session.get(
            self._network.expression(CONTROL.name),
            payload=msgspec.msgpack.encode(ControlRequest(stamp_ns=time.time_ns(), command=verb)),
            timeout=timeout_s,
        )
        for reply in replies:
            if reply.ok is not None:
                return _message(reply.ok, ControlAnswer)
        raise self._nobody("answers", CONTROL)

    def refine(
        self,
        iterations: int,
        first_rate: float = 1.0,
        last_rate: float = 1.0,
        timeout_s: float = 3.0,
    ) -> None:
        """Ask the mapper to fit the map further to the keyframes it has, with steps that shrink
        from one rate to the other. Returns at once; `map/delta` will tell what changed.

        Raises ValueError for more than 500 iterations or rates outside (0, 1], ConfigError when
        nobody listens.
        """
        message = RefineMap(
            stamp_ns=time.time_ns(),
            iterations=iterations,
            initial_rate=first_rate,
            final_rate=last_rate,
        )
        message.check()
        self._ask(MAP_REFINE, message, timeout_s)

    def add_label(self, name: str, timeout_s: float = 60.0) -> tuple[str, ...]:
        """Ask the labeller to choose from one more name when it names regions; returns all of them
        when it has. It may be busy with a region for some seconds.

        Raises ConfigError when it refuses, or nobody answers.
        """
        try:
            message = AddLabel(stamp_ns=time.time_ns(), name=name)
        except ValueError as error:
            raise ConfigError(f"{name[:40]!r} cannot be added: {error}.") from error
        until_s = time.monotonic() + timeout_s
        with self.poller(LABEL_NAMES.name, LabelNames) as inbox:
            self._ask(LABEL_ADD, message, min(timeout_s, 3.0))
            while time.monotonic() < until_s:
                for answer in inbox():
                    if answer.stamp_ns == message.stamp_ns:
                        return _names_or_why(name, answer)
                time.sleep(0.02)
        raise self._nobody("answers", LABEL_ADD)

    def _ask(self, topic: Topic, message: RefineMap | AddLabel, timeout_s: float) -> None:
        """Send, when somebody listens. Raises ConfigError when nobody does."""
        publisher, until_s = self._publisher(type(message)), time.monotonic() + timeout_s
        while not publisher.matching_status.matching:
            if time.monotonic() > until_s:
                raise self._nobody("listens", topic)
            time.sleep(0.02)
        header = Header("operator", self._epoch, self._asked, message.stamp_ns)
        publisher.put(msgspec.msgpack.encode(message), attachment=encode_link(header))
        self._asked += 1

    def _nobody(self, does: str, topic: Topic) -> ConfigError:
        return ConfigError(
            f"nobody {does} on {self._network.expression(topic.name)}: is this the name of the "
            "robot, and is its service up? `ldo doctor` tells."
        )

    def _subscriber(self, name: str, keep: int) -> Any:
        ring = zenoh.handlers.RingChannel(keep)
        return self._session.declare_subscriber(self._network.expression(name), ring)


def _topic(topic: Topic | str) -> Topic:
    if isinstance(topic, Topic):
        return topic
    if topic not in BY_NAME:
        hint = did_you_mean(topic, BY_NAME, "`ldo topics` lists all.")
        raise ConfigError(f"there is no topic {topic!r}. {hint}")
    return BY_NAME[topic]


def _names_or_why(name: str, answer: LabelNames) -> tuple[str, ...]:
    if answer.error:
        raise ConfigError(f"{name!r} is not added: {answer.error}")
    return answer.names


def _stamp(stamp_ns: int | None) -> int:
    return time.time_ns() if stamp_ns is None else stamp_ns


def _raw_depth(depth: np.ndarray) -> Image:
    return Image.raw("z16" if depth.dtype == np.uint16 else "f32", depth)


def _header(sample: Any) -> Header:
    return decode(sample.attachment.to_bytes(), Header)


def _message(sample: Any, of: type[M]) -> M:
    return decode(sample.payload.to_bytes(), of)


def _readable(samples: Iterable[Any], of: type[M]) -> Iterator[M]:
    """Their messages; what cannot be decoded, as of another version, is left out and said."""
    for sample in samples:
        try:
            yield _message(sample, of)
        except msgspec.DecodeError as error:
            log.warning("a %s cannot be read and is left out: %s", of.__name__, error)


@contextmanager
def connect(
    robot: str = "robot", endpoint: str = DEFAULT_ENDPOINT, keys: str | Path | None = None
) -> Iterator[Client]:
    """Connect to a running service; with `keys`, a folder that `ldo keys` made, over TLS.

    Raises ConfigError when nobody answers, or refuses the keys.
    """
    network = Endpoint(robot, endpoint, TlsKeys.of(keys))
    with open_session(network) as session:
        yield Client(session, network)
