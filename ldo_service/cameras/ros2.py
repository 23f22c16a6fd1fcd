"""RGB-D camera of ROS 2, whose topics a Zenoh bridge forwards.

The bridge, zenoh-bridge-ros2dds, publishes each message of a topic `/a/b` on the Zenoh key `a/b`,
encoded as CDR. It publishes a topic only while its key has a subscriber.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from threading import Condition

import zenoh

from ldo_service.errors import ConfigError, FrameError
from ldo_service.geometry.stamps import StreamPairer
from ldo_service.schemas import CameraModel, CameraRgbd

from .ros_messages import (
    RosImage,
    is_compressed,
    joined,
    read_camera,
    read_color,
    read_depth,
    typestore,
)

# Maximum number of waiting samples per topic: enough for a burst, as in the service's own input.
KEEP = 4
# Maximum number of images of a topic that wait for their counterpart: 0.27 s at 30 Hz.
PAIR_BUFFER = 8
# If a stamp is this much earlier than the newest stamp, the camera counts as restarted.
RESTARTED_AFTER_NS = 1_000_000_000
# Time without a message after which a topic is reported as silent; interval of these reports.
SILENT_AFTER_S = 5.0
# Maximum number of reported reasons. A stream of invalid data may have a new reason per message.
MAX_REASONS = 20
Notify = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RosTopics:
    """Names of the ROS topics of a camera, and properties of its images."""

    color: str  # Topic of the color images.
    depth: str  # Topic of the depth images.
    info: str = ""  # Camera info of color; empty: `camera_info` in the namespace of `color`.
    # Maximum difference between the stamps of color and depth: less than half a period at 30 Hz.
    max_skew_s: float = 0.015
    # True if the images have no distortion. The intrinsics are then the matrix P of the camera
    # info.
    is_rectified: bool = False
    # True if depth is registered to color although the frame_ids of both images differ.
    is_registered: bool = False

    def __post_init__(self) -> None:
        for topic in (self.color, self.depth, self.camera_info):
            key_of(topic)
        if not 0 <= self.max_skew_s < 10:
            raise ConfigError(f"--max-skew-s={self.max_skew_s:g} must be at least 0 and below 10.")

    @property
    def camera_info(self) -> str:
        """Topic of the color camera's CameraInfo messages."""
        base = self.color.rsplit("/", 1)[0] if is_compressed(self.color) else self.color
        return self.info or base.rpartition("/")[0] + "/camera_info"


def key_of(topic: str) -> str:
    """Return the Zenoh key of a ROS topic.

    Raises:
        ConfigError: The name of the topic is invalid.
    """
    parts = topic.strip("/").split("/")
    if not all(part.isidentifier() and part.isascii() for part in parts):
        raise ConfigError(
            f"{topic!r} is not a valid ROS topic. Write it like /camera/color/image_raw."
        )
    return "/".join(parts)


@dataclass
class Inbox:
    """Queue of samples in the order of arrival, with the newest `KEEP` of each topic."""

    dropped: int = 0  # Number of samples dropped from a full queue.
    _waiting: deque[tuple[str, bytes]] = field(default_factory=deque)
    _changed: Condition = field(default_factory=Condition)

    def put(self, topic: str, sample: zenoh.Sample) -> None:
        """Add a sample of a topic; Zenoh calls this method on its own thread."""
        body = sample.payload.to_bytes()
        with self._changed:
            of_topic = [entry for entry in self._waiting if entry[0] == topic]
            if len(of_topic) >= KEEP:
                self._waiting.remove(of_topic[0])
                self.dropped += 1
            self._waiting.append((topic, body))
            self._changed.notify()

    def take(self, timeout_s: float) -> tuple[str, bytes] | None:
        """Return topic and body of the oldest sample; None if no sample arrives in `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._waiting), timeout_s)
            return self._waiting.popleft() if self._waiting else None


class RosCamera:
    """Frames of an RGB-D camera from three ROS topics.

    Unusable messages are counted, and each reason is reported once.
    """

    def __init__(self, topics: RosTopics, notify: Notify) -> None:
        """Prepare to receive frames.

        Args:
            topics: The topics.
            notify: Function that reports a message to the user.
        """
        typestore()
        self._topics, self._notify = topics, notify
        self._inbox = Inbox()
        self._pairing = self._new_pairing()
        self._newest_ns = 0
        self._camera: CameraModel | None = None
        self._reasons: set[str] = set()
        self._last_s = dict.fromkeys((topics.color, topics.depth, topics.camera_info), 0.0)
        self._notified_s = time.monotonic()
        self.frames_made = self.rejected = 0

    @property
    def statistics(self) -> str:
        """Text with the numbers of frames, rejected and unpaired images, and dropped messages."""
        return (
            f"{self.frames_made} frames, {self.rejected} images rejected, {self._pairing.lost_a} "
            f"color and {self._pairing.lost_b} depth images unpaired, {self._inbox.dropped} dropped"
        )

    def frames(self, session: zenoh.Session) -> Iterator[CameraRgbd]:
        """Subscribe to the topics, and iterate over the frames without end."""
        with ExitStack() as stack:
            for topic in self._last_s:
                handler = zenoh.handlers.Callback(partial(self._inbox.put, topic), indirect=False)
                stack.enter_context(session.declare_subscriber(key_of(topic), handler))
            while True:
                taken = self._inbox.take(SILENT_AFTER_S)
                if taken is not None:
                    yield from self.take(*taken)
                self._notice_silence()

    def take(self, topic: str, body: bytes) -> Iterator[CameraRgbd]:
        """Process a message of a topic, and iterate over the frames that the message completes."""
        self._last_s[topic] = time.monotonic()
        try:
            for color, depth in self._pairs(topic, body):
                yield self._frame(color, depth)
        except FrameError as error:
            self.rejected += 1
            reason = f"{topic}: {str(error)[:30]}"
            if reason not in self._reasons and len(self._reasons) < MAX_REASONS:
                self._notify(f"{topic}: {error} Further such messages are only counted.")
                self._reasons.add(reason)

    def _pairs(self, topic: str, body: bytes) -> Iterator[tuple[RosImage, RosImage]]:
        if topic == self._topics.camera_info:
            self._camera = read_camera(body, self._topics.is_rectified)
        elif topic == self._topics.color:
            color = read_color(body, topic)
            yield from self._pairing_at(color.stamp_ns).add_a(color)
        else:
            depth = read_depth(body, topic)
            yield from self._pairing_at(depth.stamp_ns).add_b(depth)

    def _pairing_at(self, stamp_ns: int) -> StreamPairer[RosImage, RosImage]:
        """Return the pairer of color and depth; replace it first if the stamps were set back.

        A stamp more than RESTARTED_AFTER_NS before the newest one means that the camera driver or
        the bag was restarted.
        """
        if stamp_ns < self._newest_ns - RESTARTED_AFTER_NS:
            self._notify("The stamps went back: the camera has restarted. No action needed.")
            self._pairing, self._newest_ns = self._new_pairing(), 0
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return self._pairing

    def _new_pairing(self) -> StreamPairer[RosImage, RosImage]:
        return StreamPairer(round(self._topics.max_skew_s * 1e9), PAIR_BUFFER)

    def _frame(self, color: RosImage, depth: RosImage) -> CameraRgbd:
        if self._camera is None:
            raise FrameError(
                f"no camera info was received on {self._topics.camera_info} yet. If none arrives, "
                "check that the camera publishes this topic."
            )
        frame = joined(color, depth, self._camera, self.frames_made, self._topics.is_registered)
        self.frames_made += 1
        return frame

    def _notice_silence(self) -> None:
        now_s = time.monotonic()
        if now_s - self._notified_s < SILENT_AFTER_S:
            return
        self._notified_s = now_s
        since_s = now_s - SILENT_AFTER_S
        silent = [topic for topic, last_s in self._last_s.items() if last_s < since_s]
        if silent:
            self._notify(
                f"No messages on {', '.join(silent)} for {SILENT_AFTER_S:g} s. Check that `ros2 "
                "topic hz` shows messages and that the bridge is connected to this network."
            )
