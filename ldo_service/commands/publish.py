"""Command `ldo publish`: send the frames of a sequence or a camera to a service."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Annotated

import msgspec
import tyro
from rich.console import Console

from ldo_service.cameras import realsense
from ldo_service.client import Client, connect
from ldo_service.config import load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry.sequence import Sequence
from ldo_service.runs.source import PriorSource, Selection, recorded_prior
from ldo_service.transport.endpoint import DEFAULT_ENDPOINT, Endpoint
from ldo_service.transport.keys import TlsKeys

from .live_camera import (
    REALSENSE,
    ROS2,
    RealSenseOptions,
    RosOptions,
    frames_of_ros,
    relay,
    require_no_sequence,
)
from .options import (
    ConfigFile,
    EndpointAddress,
    KeysFolder,
    MaxFrames,
    RecordedOdometry,
    Robot,
    Settings,
    Stride,
    Topics,
    argument,
    note_console,
    progress,
    with_topics,
)

FIRST_REALSENSE, NO_TOPICS = RealSenseOptions(), RosOptions()
MAX_BAD = 0.1  # The command fails if more than this fraction of the frames cannot be read.


PublishSource = Annotated[
    str,
    tyro.conf.Positional,
    argument(metavar="SOURCE", help="a data set, as for `ldo run`; `realsense`; or `ros2`"),
]
Rate = Annotated[
    float | None, argument(metavar="HZ", help="frames per second; default: as recorded")
]
Restamp = Annotated[
    bool,
    argument(
        help="replace each stamp by the time of sending, for example to send a data set again"
    ),
]


def publish(
    source: PublishSource,
    robot: Robot = "robot",
    endpoint: EndpointAddress = DEFAULT_ENDPOINT,
    keys: KeysFolder = None,
    rate: Rate = None,
    stride: Stride = 1,
    max_frames: MaxFrames = None,
    restamp: Restamp = False,
    config: ConfigFile = None,
    set: Settings = (),
    topic: Topics = (),
    recorded_odometry: RecordedOdometry = False,
    usb: RealSenseOptions = FIRST_REALSENSE,
    ros: RosOptions = NO_TOPICS,
) -> None:
    """Publish the frames of a sequence or a camera on camera/rgbd.

    `realsense` is a camera on USB. `ros2` reads topics of ROS 2 that a Zenoh bridge forwards.

    Frames keep the stamps of the source. The service rejects a frame whose stamp equals the
    stamp of the frame before, or is up to a second earlier. It accepts a stamp that is more than a
    second earlier, as after a restart of the camera. --restamp replaces each stamp by the time of
    sending, so that you can send a data set again. A subscriber on this machine can then compute
    the delay of a pose: the present time minus the stamp of the pose.

      ldo publish ~/data/rgbd_dataset_freiburg1_desk --rate 15
      ldo publish ~/data/rgbd_dataset_freiburg1_desk --restamp
      ldo publish realsense --size 848x480
      ldo publish ros2 --color /camera/color/image_raw --depth /camera/aligned_depth/image_raw
    """
    console = note_console()
    selection = Selection(stride, max_frames)
    if source in (REALSENSE, ROS2):
        require_no_sequence(
            source,
            **{
                "rate": rate,
                "config": config,
                "set": set,
                "topic": topic,
                "recorded-odometry": recorded_odometry,
            },
        )
        live = (
            realsense.frames(usb.stream())
            if source == REALSENSE
            else frames_of_ros(ros, Endpoint(robot, endpoint, TlsKeys.of(keys)), console.print)
        )
        with connect(robot, endpoint, keys) as service, closing(live):
            relay(service, live, selection, restamp, console.print)
        return
    if rate is not None and not 0 < rate < float("inf"):
        raise ConfigError(f"--rate {rate:g} must be positive and finite.")
    settings = load_config(config, with_topics(set, topic))
    sequence = open_sequence(source, settings.dataset.options())
    indices = selection.indices(sequence)
    recorded = (
        recorded_prior(sequence, indices, settings, console.print) if recorded_odometry else None
    )
    with connect(robot, endpoint, keys) as service:
        service.wait_for_subscriber()
        camera = SequencePublisher(
            *(service, sequence, PriorSource(recorded), restamp, console.print)
        )
        publish_all(camera, indices, rate, console)


def publish_all(
    camera: "SequencePublisher", indices: range, rate: float | None, console: Console
) -> None:
    """Publish frames of a sequence with a progress bar.

    Args:
        camera: The publisher.
        indices: Indices of the frames.
        rate: Frames per second; None keeps the intervals of the recorded stamps.
        console: Console of the progress bar and of the note at the end.

    Raises:
        DataError: More than MAX_BAD of the frames cannot be read.
    """
    with progress("publish", len(indices), console) as advance:
        for done, index in enumerate(paced(camera.sequence, indices, rate), 1):
            camera.send(index)
            advance(done)
    console.print(
        f"{camera.sent} frames published, {camera.bad} unreadable, "
        f"{camera.unreceived} without subscriber; `ldo doctor` shows how many the service rejected"
    )
    if camera.bad > MAX_BAD * len(indices):
        raise DataError(
            f"{camera.bad} of {len(indices)} frames could not be read, more than the maximum of "
            f"{MAX_BAD:.0%}. The reason for the first is printed above. Restore the damaged files."
        )


class SequencePublisher:
    """Publisher of the frames of a sequence.

    The publisher notifies the user of the first unreadable frame, and each time the last subscriber
    disconnects.
    """

    def __init__(
        self,
        service: Client,
        sequence: Sequence,
        prior: PriorSource,
        restamp: bool,
        notify: Callable[[str], None],
    ) -> None:
        self.sequence, self._service, self._prior = sequence, service, prior
        self._restamp, self._notify = restamp, notify
        self._had_subscriber = True
        self.sent = self.bad = self.unreceived = 0

    def send(self, index: int) -> None:
        """Send the poses of the odometry prior up to the stamp of a frame, then the frame.

        A frame that cannot be read is counted in `bad` and skipped.
        """
        self._notice_listeners()
        try:
            message = raw_frame_to_message(self.sequence.read(index))
        except FrameError as error:
            if self.bad == 0:
                self._notify(f"{error} The frame is skipped; further bad frames are only counted.")
            self.bad += 1
            return
        shift_ns = time.time_ns() - message.stamp_ns if self._restamp else 0
        for pose in self._prior.until(message.stamp_ns):
            self._service.publish_prior(pose.T_prior_base, pose.stamp_ns + shift_ns)
        self._service.send(msgspec.structs.replace(message, stamp_ns=message.stamp_ns + shift_ns))
        self.sent += 1
        self.unreceived += not self._had_subscriber

    def _notice_listeners(self) -> None:
        has_subscriber = self._service.has_subscriber
        if self._had_subscriber and not has_subscriber:
            self._notify("camera/rgbd has no subscriber any more: is the service still running?")
        self._had_subscriber = has_subscriber


def paced(sequence: Sequence, indices: range, rate: float | None) -> Iterator[int]:
    """Yield the index of each frame at the time when the frame must be sent.

    Args:
        sequence: The sequence.
        indices: Indices of the frames to send.
        rate: Frames per second; None keeps the intervals of the recorded stamps.
    """
    started_s = time.monotonic()
    first_ns = int(sequence.stamps_ns[indices[0]]) if indices else 0
    for number, index in enumerate(indices):
        due_s = number / rate if rate else (int(sequence.stamps_ns[index]) - first_ns) * 1e-9
        time.sleep(max(0.0, started_s + due_s - time.monotonic()))
        yield index
